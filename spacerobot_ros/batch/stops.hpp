// Joint stops and locks of the lanes where a joint touches its limit: JointStops of
// simulation/effort_plant.py, whose docstring has the equations. Integration steps are taken by all
// lanes together, impulses at the stops lane by lane.

#define STATE (2 * JOINTS + 13)

typedef double Matrix[JOINTS][JOINTS];
typedef double Rates[JOINTS];
typedef unsigned long long Set;  // of joints, as bits

static bool in(Set joints, int j) { return joints >> j & 1; }

// Invert a positive definite matrix in place (Gauss-Jordan).
static void invert(Matrix &A) {
  for (int k = 0; k < JOINTS; ++k) {
    const double pivot = 1.0 / A[k][k];
    A[k][k] = 1.0;
    for (double &a : A[k]) a *= pivot;
    for (int i = 0; i < JOINTS; ++i) {
      if (i == k) continue;
      const double factor = A[i][k];
      A[i][k] = 0.0;
      for (int j = 0; j < JOINTS; ++j) A[i][j] -= factor * A[k][j];
    }
  }
}

// Give the rates after impulses that bring some joints to rest, and the impulses.
static void stop_joints(const Matrix &compliance, const Rates &rates, Set joints, Rates &after,
                        Rates &impulses) {
  Matrix of_joints;
  for (int i = 0; i < JOINTS; ++i)
    for (int j = 0; j < JOINTS; ++j)
      of_joints[i][j] = in(joints, i) && in(joints, j) ? compliance[i][j] : i == j;
  invert(of_joints);
  for (int i = 0; i < JOINTS; ++i) {
    impulses[i] = 0.0;
    for (int j = 0; j < JOINTS; ++j)
      if (in(joints, i) && in(joints, j)) impulses[i] -= of_joints[i][j] * rates[j];
  }
  for (int i = 0; i < JOINTS; ++i) {
    after[i] = rates[i];
    for (int j = 0; j < JOINTS; ++j) after[i] += compliance[i][j] * impulses[j];
    if (in(joints, i)) after[i] = 0.0;
  }
}

// Return the joints that their stops bring to rest, so that inward * rates >= 0 (Murty's
// least-index pivoting from a guess).
static Set joints_stopped(const Matrix &compliance, const Rates &rates, const Rates &inward,
                          Set joints) {
  // Sets that repeat differ from each other by rounding only: any of them is right.
  for (int tries = 0; tries < 1000; ++tries) {
    Rates after, impulses;
    stop_joints(compliance, rates, joints, after, impulses);
    int wrong = 0;
    while (wrong < JOINTS && inward[wrong] * (in(joints, wrong) ? impulses : after)[wrong] >= 0.0)
      ++wrong;
    if (wrong == JOINTS) break;
    joints ^= Set(1) << wrong;
  }
  return joints;
}

struct Stops {
  const V *group;
  double step;  // longest integration step, s
  V x[STATE], after[STATE];
  Set held[LANES] = {}, stopped[LANES] = {};

  void equations(V *K, V *Q) {
    const V *arguments[ARGUMENT_POINTERS] = {x, group + REALISED_ROW, group + row::p};
    V *results[RESULT_POINTERS] = {K, Q};
    run<SHAPE_EQUATIONS>(arguments, results);
  }

  void integrate(V h) {
    V free[JOINTS];
    for (int j = 0; j < JOINTS; ++j)
      for (int lane = 0; lane < LANES; ++lane) free[j].x[lane] = !in(held[lane], j);
    const V *arguments[ARGUMENT_POINTERS] = {x, group + REALISED_ROW, free, &h, group + row::p};
    V *results[RESULT_POINTERS] = {after};
    run<HOLDING_STEP>(arguments, results);
  }

  V is_outside() const {
    V flags(0.0);
    for (int j = 0; j < JOINTS; ++j)
      flags = flags || after[j] < V(BELOW[j]) || after[j] > V(ABOVE[j]);
    return flags;
  }

  // Bring joints on their stops to rest, and find those that their stops hold in the next step.
  void bring_to_rest(V lanes) {
    V K[JOINTS * JOINTS], Q[JOINTS], on_stop(0.0);
    for (int j = 0; j < JOINTS; ++j)
      on_stop = on_stop || x[j] <= V(LOWER[j]) || x[j] >= V(UPPER[j]);
    on_stop = on_stop && lanes;
    if (any(on_stop)) equations(K, Q);
    for (int lane = 0; lane < LANES; ++lane) {
      if (lanes.x[lane] == 0.0) continue;
      if (on_stop.x[lane] == 0.0) {
        held[lane] = 0;
        continue;
      }
      Matrix compliance;
      Rates inward, rates, pushed, impulses;
      bool arrives = false;
      for (int j = 0; j < JOINTS; ++j) {
        const double q = x[j].x[lane];
        inward[j] = q <= LOWER[j] ? 1.0 : q >= UPPER[j] ? -1.0 : 0.0;
        rates[j] = x[JOINTS + 4 + j].x[lane];
        arrives = arrives || inward[j] * rates[j] < 0.0;
        for (int i = 0; i < JOINTS; ++i) compliance[i][j] = K[j * JOINTS + i].x[lane];
      }
      invert(compliance);
      if (arrives) {
        const Set touched = joints_stopped(compliance, rates, inward, 0);
        stopped[lane] |= touched;
        Rates before;
        for (int j = 0; j < JOINTS; ++j) before[j] = rates[j];
        stop_joints(compliance, before, touched, rates, impulses);
      }
      for (int i = 0; i < JOINTS; ++i) {
        pushed[i] = rates[i];
        for (int j = 0; j < JOINTS; ++j) pushed[i] += step * compliance[i][j] * Q[j].x[lane];
      }
      held[lane] = joints_stopped(compliance, pushed, inward, held[lane]);
      stopped[lane] |= held[lane];
      stop_joints(compliance, rates, held[lane], pushed, impulses);
      for (int j = 0; j < JOINTS; ++j) x[JOINTS + 4 + j].x[lane] = pushed[j];
    }
  }

  // Fly some lanes for a tick; return those that failed, by 1 and the number of the reason.
  V advance(double duration, V lanes) {
    V left(duration), arrivals(MAX_ARRIVALS_PER_STEP * JOINTS * ceil(duration / step)), failed(0.0);
    for (int k = 0; k < STATE; ++k) x[k] = group[row::state + k];
    bring_to_rest(lanes);
    for (; any(lanes = lanes && left > V(1e-12 * duration)); bring_to_rest(lanes)) {
      V h = where(lanes, fmin(V(step), left)), finite(1.0);
      integrate(h);
      const V outside = lanes && is_outside();
      if (any(outside)) {
        V early(0.0), late = h;
        for (int k = 0; k < BISECTIONS; ++k) {
          const V middle = (early + late) / V(2.0);
          integrate(middle);
          const V leaves = is_outside();
          assign_where(leaves, late, middle);
          assign_where(!leaves, early, middle);
        }
        assign_where(outside, h, late);
        integrate(h);
        for (int j = 0; j < JOINTS; ++j)
          assign_where(outside, after[j], fmin(fmax(after[j], V(LOWER[j])), V(UPPER[j])));
        arrivals -= outside;
        assign_where(arrivals < V(0.0), failed, V(2.0));
      }
      for (const V &each : after) finite = finite && fabs(each) < V(INFINITY);
      assign_where(lanes && !finite, failed, V(1.0));
      lanes = lanes && failed == V(0.0);
      for (int k = 0; k < STATE; ++k) assign_where(lanes, x[k], after[k]);
      left -= h;
    }
    return failed;
  }
};
