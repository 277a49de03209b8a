// Thrusters that are on or off, lane by lane: what ThrusterAllocation and ThrusterModulator do.

#if THRUSTERS > 0
static const double THRUST_ROUNDING = 1e-9, DEPENDENT = 1e-9;

// Least squares by Householder's reflections: COUNT columns of ROWS numbers, COUNT <= ROWS. The
// result is false where columns depend on each other.
template <int ROWS>
static bool least_squares(const double *matrix, int stride, const int *chosen, int count,
                          const double *wanted, double *x) {
  double a[ROWS][ROWS], b[ROWS], diagonal[ROWS];
  for (int j = 0; j < count; ++j)
    for (int i = 0; i < ROWS; ++i) a[j][i] = matrix[chosen[j] * stride + i];
  for (int i = 0; i < ROWS; ++i) b[i] = wanted[i];
  for (int j = 0; j < count; ++j) {
    double square = 0.0;
    for (int i = j; i < ROWS; ++i) square += a[j][i] * a[j][i];
    const double size = sqrt(square);
    diagonal[j] = a[j][j] > 0.0 ? -size : size;
    a[j][j] -= diagonal[j];
    const double half = -diagonal[j] * a[j][j];
    if (!(half > 0.0)) return false;
    for (int k = j + 1; k <= count; ++k) {
      double *column = k < count ? a[k] : b;
      double product = 0.0;
      for (int i = j; i < ROWS; ++i) product += a[j][i] * column[i];
      for (int i = j; i < ROWS; ++i) column[i] -= product / half * a[j][i];
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
// result is false where it does not end.
static bool cheapest(const double *matrix, const double *wanted, double *share) {
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

// Make up for what the cost has taken from the wrench.
static bool complete(const double *matrix, const double *wanted, double *share) {
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

// Allocate the impulse that is outstanding after the commanded wrench; return whether the result
// is more than the thrusters can give, or cannot be found here.
static bool allocate_lane(const Job &job, V *group, int lane) {
  double wanted[7], share[THRUSTERS], square = 0.0;
  for (int i = 0; i < 6; ++i) {
    const double owed = group[job.owed_row + i].x[lane];
    wanted[i] = job.thruster_weights[i] *
                (owed + job.period * group[job.wanted_row + i].x[lane]);
    square += wanted[i] * wanted[i];
  }
  const double size = sqrt(square);
  wanted[6] = 0.0;
  for (int j = 0; j < THRUSTERS; ++j) group[job.levels_row + j].x[lane] = 0.0;
  if (!(size > 0.0)) return false;
  for (int i = 0; i < 6; ++i) wanted[i] /= size;
  if (!cheapest(job.thruster_matrix, wanted, share)) return true;
  if (!complete(job.thruster_matrix, wanted, share)) return true;
  for (int j = 0; j < THRUSTERS; ++j) {
    const double most = job.thruster_shortest[j] + job.period - group[job.left_row + j].x[lane];
    if (share[j] > most / size) return true;
    group[job.levels_row + j].x[lane] = std::min(size * share[j], most);
  }
  return false;
}

static bool allocate(const Job &job, V *group) {
  bool waits = false;
  for (int i = 0; i < 6; ++i) group[job.wanted_row + i] = group[job.command_row + job.n + i];
  for (int lane = 0; lane < LANES; ++lane) {
    const bool alive = group[job.alive_row].x[lane] != 0.0;
    const bool beyond = alive && allocate_lane(job, group, lane);
    group[job.unallocated_row].x[lane] = beyond;
    waits = waits || beyond;
  }
  return waits;
}

// Fire the thrusters for a period; what they give becomes the command.
static void fire(const Job &job, V *group) {
  const double h = job.period, least = THRUST_ROUNDING * h;
  for (int lane = 0; lane < LANES; ++lane) {
    double owed[6] = {}, wrench[6] = {}, flow = 0.0;
    for (int j = 0; j < THRUSTERS; ++j) {
      const double given = group[job.levels_row + j].x[lane], shortest = job.thruster_shortest[j];
      const double level = given > least ? given : 0.0, left = group[job.left_row + j].x[lane];
      const bool on = group[job.on_row + j].x[lane] != 0.0;
      const bool begins = !on && level > 0.0 && level >= (1.0 - THRUST_ROUNDING) * shortest;
      double more = 0.0;
      if (on) more = std::min(level, std::max(h - left, 0.0));
      else if (begins) more = std::max(std::min(level, h), shortest);
      const double on_time = std::min(left + more, h), remains = left + more - on_time;
      group[job.left_row + j].x[lane] = remains <= least ? 0.0 : remains;
      group[job.on_row + j].x[lane] = on_time >= (1.0 - THRUST_ROUNDING) * h;
      for (int i = 0; i < 6; ++i) {
        owed[i] += job.thruster_wrenches[j * 6 + i] * (given - more);
        wrench[i] += job.thruster_wrenches[j * 6 + i] * (on_time / h);
      }
      flow += job.thruster_flow[j] * (on_time / h);
    }
    for (int i = 0; i < 6; ++i) {
      group[job.owed_row + i].x[lane] = owed[i];
      group[job.command_row + job.n + i].x[lane] = wrench[i];
    }
    if (group[job.alive_row].x[lane] != 0.0) group[job.propellant_row].x[lane] += h * flow;
  }
}
#endif
