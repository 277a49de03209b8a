// The allocation of ThrusterAllocation (control/thrusters.py) in C++. There are two of them because
// the steps of its active-set method differ from lane to lane; a test compares them.

#if THRUSTERS > 0
static const double DEPENDENT = 1e-9;

// Least squares by Householder's reflections: COUNT columns of SIZE numbers, COUNT <= SIZE. The
// result is false if columns depend on each other.
template <int SIZE>
static bool least_squares(const double *matrix, int stride, const int *chosen, int count,
                          const double *wanted, double *x) {
  double a[SIZE][SIZE], b[SIZE], diagonal[SIZE];
  for (int j = 0; j < count; ++j)
    for (int i = 0; i < SIZE; ++i) a[j][i] = matrix[chosen[j] * stride + i];
  for (int i = 0; i < SIZE; ++i) b[i] = wanted[i];
  for (int j = 0; j < count; ++j) {
    double square = 0.0;
    for (int i = j; i < SIZE; ++i) square += a[j][i] * a[j][i];
    const double size = sqrt(square);
    diagonal[j] = a[j][j] > 0.0 ? -size : size;
    a[j][j] -= diagonal[j];
    const double half = -diagonal[j] * a[j][j];
    if (!(half > 0.0)) return false;
    for (int k = j + 1; k <= count; ++k) {
      double *column = k < count ? a[k] : b;
      double product = 0.0;
      for (int i = j; i < SIZE; ++i) product += a[j][i] * column[i];
      for (int i = j; i < SIZE; ++i) column[i] -= product / half * a[j][i];
    }
  }
  for (int j = count - 1; j >= 0; --j) {
    x[j] = b[j];
    for (int k = j + 1; k < count; ++k) x[j] -= a[k][j] * x[k];
    x[j] /= diagonal[j];
  }
  return true;
}

// Non-negative least squares (Lawson and Hanson) with the cost as the last of seven rows. The
// result is false if it does not end.
static bool nonnegative_least_squares(const double *matrix, const double *wanted, double *share) {
  int chosen[8], count = 0;
  bool taken[THRUSTERS] = {};
  double z[8];
  for (int j = 0; j < THRUSTERS; ++j) share[j] = 0.0;
  for (int round = 0; round < 3 * THRUSTERS; ++round) {
    double rest[7];
    for (int i = 0; i < 7; ++i) {
      rest[i] = wanted[i];
      for (int k = 0; k < count; ++k) rest[i] -= matrix[chosen[k] * 7 + i] * share[chosen[k]];
    }
    bool refused[THRUSTERS] = {};
    int next;
    for (;;) {
      double most = 0.0;
      next = -1;
      for (int j = 0; j < THRUSTERS; ++j) {
        if (taken[j] || refused[j]) continue;
        double gain = 0.0;
        for (int i = 0; i < 7; ++i) gain += matrix[j * 7 + i] * rest[i];
        if (gain > most) most = gain, next = j;
      }
      if (next < 0) return true;
      if (count == 7) return false;
      chosen[count] = next;
      if (least_squares<7>(matrix, 7, chosen, count + 1, wanted, z) && z[count] > 0.0) break;
      refused[next] = true;
    }
    taken[next] = true;
    ++count;
    for (;;) {
      double step = 1.0;
      for (int k = 0; k < count; ++k)
        if (z[k] <= 0.0) {
          const double x = share[chosen[k]];
          step = std::min(step, x / (x - z[k]));
        }
      if (step == 1.0) break;
      int kept = 0;
      for (int k = 0; k < count; ++k) {
        double &x = share[chosen[k]];
        const bool ends = z[k] <= 0.0 && x / (x - z[k]) <= step;
        x += step * (z[k] - x);
        if (ends || x <= 0.0) {
          x = 0.0;
          taken[chosen[k]] = false;
        } else {
          chosen[kept++] = chosen[k];
        }
      }
      count = kept;
      if (!count || !least_squares<7>(matrix, 7, chosen, count, wanted, z)) return false;
    }
    for (int k = 0; k < count; ++k) share[chosen[k]] = z[k];
  }
  return false;
}

// Restore the part of the wrench that the cost has taken.
static bool correct(const double *matrix, const double *wanted, double *share) {
  int chosen[THRUSTERS], count = 0;
  double rest[6], more[6];
  for (int i = 0; i < 6; ++i) rest[i] = wanted[i];
  for (int j = 0; j < THRUSTERS; ++j)
    if (share[j] > 0.0) {
      for (int i = 0; i < 6; ++i) rest[i] -= matrix[j * 7 + i] * share[j];
      chosen[count++] = j;
    }
  if (count > 6 || !least_squares<6>(matrix, 7, chosen, count, rest, more)) return false;
  for (int k = 0; k < count; ++k) {
    if (!(fabs(more[k]) < DEPENDENT)) return false;
    share[chosen[k]] = std::max(share[chosen[k]] + more[k], 0.0);
  }
  return true;
}

// Find levels, each within most, for an impulse; return 0 if it is more than the thrusters can give
// or if it cannot be found here, otherwise 1.
extern "C" int allocate_levels(const double *matrix, const double *weights, const double *impulse,
                               const double *most, double *levels) {
  double wanted[7], share[THRUSTERS], square = 0.0;
  for (int i = 0; i < 6; ++i) {
    wanted[i] = weights[i] * impulse[i];
    square += wanted[i] * wanted[i];
  }
  const double size = sqrt(square);
  wanted[6] = 0.0;
  for (int j = 0; j < THRUSTERS; ++j) levels[j] = 0.0;
  if (!(size > 0.0)) return 1;
  for (int i = 0; i < 6; ++i) wanted[i] /= size;
  if (!nonnegative_least_squares(matrix, wanted, share)) return 0;
  if (!correct(matrix, wanted, share)) return 0;
  for (int j = 0; j < THRUSTERS; ++j) {
    if (share[j] > most[j] / size) return 0;
    levels[j] = std::min(size * share[j], most[j]);
  }
  return 1;
}
#endif
