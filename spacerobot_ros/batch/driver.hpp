// Flies groups of flights, one in each lane, tick by tick. LANES numbers that belong together are a
// row; the memory of a group is a table of ROWS rows.
//
// native.py generates the declarations before this file: the first row of each name (namespace row),
// sizes, enumerations, struct Job, and the rows of the arguments and results of CasADi's functions.
// FLIGHT and REPORT step a tick; REPORT also gives the results of reports. CONTROL gives a
// controller's command and decision for a state. HOLDING_STEP and SHAPE_EQUATIONS are those of robots
// whose joints have stops.

static bool any(V flags) {
  for (int lane = 0; lane < LANES; ++lane)
    if (flags.x[lane] != 0.0) return true;
  return false;
}

INLINE void assign_where(V flag, V &to, V value) { to.x = flag.x != 0.0 ? value.x : to.x; }

typedef int Function(const V **, V **, long long *, V *, int);

template <Function *function>
static void run(const V **in, V **out) {
#ifdef __CUDACC_RTC__
  long long integers[INTEGER_SIZE];
  V work[WORK_SIZE];
#else
  static thread_local long long integers[INTEGER_SIZE];
  static thread_local V *work = nullptr;
  if (!work) work = (V *)aligned_alloc(64, ((WORK_SIZE * sizeof(V)) / 64 + 1) * 64);
#endif
  function(in, out, integers, work, 0);
}

// Evaluate a function on the rows of a group.
template <Function *function, int ARGUMENTS, int RESULTS>
static void call(V *group, const long long (&arguments)[ARGUMENTS],
                 const long long (&results)[RESULTS]) {
  const V *in[ARGUMENT_POINTERS];
  V *out[RESULT_POINTERS];
  for (int i = 0; i < ARGUMENTS; ++i) in[i] = group + arguments[i];
  for (int i = 0; i < RESULTS; ++i) out[i] = group + results[i];
  run<function>(in, out);
}

static void evaluate(V *group, bool report) {
  if (report)
    call<REPORT>(group, REPORT_ARGUMENTS, REPORT_RESULTS);
  else
    call<FLIGHT>(group, FLIGHT_ARGUMENTS, FLIGHT_RESULTS);
}

static long long instant_of(const Job &job, long long tick) {
  for (long long i = 0; i < job.instant_count; ++i)
    if (job.instants[i] == tick) return i;
  return -1;
}

// Return the place of an entry in a table that has `size` entries for each group.
static long long place(const Job &job, long long g, long long size, long long entry) {
#ifdef THREADS
  return entry * job.groups + g;  // Threads that run together read numbers side by side.
#else
  return g * size + entry;
#endif
}

typedef unsigned long long Word;

// Return the upper half of a product.
static Word upper(Word a, Word b) {
#ifdef __CUDA_ARCH__
  return __umul64hi(a, b);
#else
  return Word((unsigned __int128)a * b >> 64);
#endif
}

// Encrypt a counter by Philox 4x64 with ten rounds (Salmon and others, SC 2011).
static void encrypt(Word key, Word (&x)[4]) {
  Word other = 0;
  for (int k = 0; k < 10; ++k) {
    const Word a = 0xD2E7470EE14C6C93 * x[0], b = 0xCA5A826395121157 * x[2];
    const Word c = upper(0xD2E7470EE14C6C93, x[0]), d = upper(0xCA5A826395121157, x[2]);
    x[0] = d ^ x[1] ^ key, x[1] = b, x[2] = c ^ x[3] ^ other, x[3] = a;
    key += 0x9E3779B97F4A7C15, other += 0xBB67AE8584CAA73B;
  }
}

// Compute four normal numbers of a group, from a column that four divides: see NormalNumbers.
static void normals(const Job &job, long long g, long long tick, int column, V (&to)[4]) {
  Numbers shares[4];
  for (int lane = 0; lane < LANES; ++lane) {
    Word x[4] = {Word(tick * ((NORMALS + 3) / 4) + column / 4 + 1)};
    encrypt(job.seeds[g * LANES + lane], x);
    for (int k = 0; k < 4; ++k) shares[k][lane] = (double(x[k] >> 11) + 0.5) * 0x1p-53;
  }
  for (int k = 0; k < 4; k += 2) {
    const V size = sqrt(V(-2.0) * log(V(shares[k]))), turn = V(6.283185307179586) * V(shares[k + 1]);
    to[k] = size * cos(turn), to[k + 1] = size * sin(turn);
  }
}

// Compute the normal numbers of a group from a column on, which four divides, up to another one.
static void normals(const Job &job, long long g, long long tick, int from, int until, V *to) {
  for (int column = from; column < until; column += 4) {
    V four[4];
    normals(job, g, tick, column, four);
    for (int k = column; k < column + 4 && k < until; ++k) to[k - from] = four[k - column];
  }
}

static void record(const Job &job, long long g, long long tick, const V *group) {
  const long long instant = instant_of(job, tick), size = job.instant_count * REPORT_ROWS;
  if (instant < 0) return;
  if (job.seeds) {
    V drawn[NORMALS];
    normals(job, g, tick, 0, NORMALS, drawn);
    for (long long k = 0; k < NORMALS; ++k)
      job.normals[place(job, g, job.instant_count * NORMALS, instant * NORMALS + k)] = drawn[k];
  }
  for (const Span &span : REPORTED)
    for (long long k = 0; k < span.count; ++k)
      job.reports[place(job, g, size, instant * REPORT_ROWS + span.to + k)] = group[span.from + k];
}

// Return one number of each lane.
static V lanes_of(const double *each) {
  Numbers numbers;
  for (int lane = 0; lane < LANES; ++lane) numbers[lane] = each[lane];
  return V(numbers);
}

static V entry(const Job &job, long long g, long long tick, long long column) {
  const long long entry = tick * COMMANDS + column;
  if (!job.each_table) return V(job.table[entry]);
  return lanes_of(job.table + LANES * place(job, g, job.table_ticks * COMMANDS, entry));
}

#ifndef CONTROL
static void measure(const Job &job, long long g, long long tick, V *group) {
  V *measured = group + row::measured;
  const V *q = group + row::state, *bias = group + row::joint_bias;
  // The first twelve are of the base.
  if (job.noisy) normals(job, g, tick, 12, 12 + JOINTS, measured);
  for (long long j = 0; j < JOINTS; ++j)
    measured[j] = job.noisy ? q[j] + bias[j] + group[row::joint_noise] * measured[j] : q[j];
}

static void command(const Job &job, long long g, long long tick, V *group) {
  if (job.program == program::GIVEN) return;
  V *to = group + row::command;
  if (job.program == program::HELD) {
    for (long long j = 0; j < COMMANDS; ++j)
      to[j] = tick < job.table_ticks ? entry(job, g, tick, j) : V(0.0);
    return;
  }
  measure(job, g, tick, group);
  const V *measured = group + row::measured;
  const long long last = job.table_ticks - 1, k = tick < last ? tick : last;
  const V gain(job.gain), band(job.deadband);
  for (long long j = 0; j < COMMANDS; ++j) {
    const V wanted = entry(job, g, k, j);
    const V velocity =
        k < last ? (entry(job, g, k + 1, j) - wanted) / V(job.period) : V(0.0);
    if (job.deadband > 0) {
      V error = wanted - measured[j];
      error -= fmin(fmax(error, -band), band);
      to[j] = velocity + gain * error;
    } else {
      to[j] = measured[j] * -gain + (velocity + gain * wanted);
    }
  }
}
#endif

#ifdef CONTROL
// Measure the state and evaluate the command for it; return whether lanes need Python for it.
static bool control(const Job &job, long long g, long long tick, V *group) {
  if (job.noisy) normals(job, g, tick, 0, NORMALS, group + row::normals);
  group[row::time] = V(double(tick * job.period_ns) / 1e9);
  call<CONTROL>(group, CONTROL_ARGUMENTS, CONTROL_RESULTS);
  V &decision = group[row::decision];
  const V undecided = decision == V(double(decision::NONE));
  const V now = undecided && group[row::verdict] && group[row::alive];
  if (any(now)) {
    assign_where(now, decision, group[row::verdict]);
    assign_where(now, group[row::decided], V(double(tick)));
    for (int k = 0; k < 2 * JOINTS + 13; ++k)
      assign_where(now, group[row::decided_state + k], group[row::measured + k]);
  }
  return any(group[row::exact] && group[row::alive]);
}

// Measure the first state of a group, from which references begin.
static void measure_start(const Job &job, long long g, V *group) {
  control(job, g, 0, group);
  group[row::decision] = V(double(decision::NONE));
  group[row::decided] = V(-1.0);
}

// End flights of a group after the tick that is committed.
static void end_where(const Job &job, long long g, V *group, V ending) {
  V &alive = group[row::alive];
  ending = ending && alive;
  if (!any(ending)) return;
  for (const Span &span : REPORTED)
    for (long long k = 0; k < span.count; ++k)
      assign_where(ending, group[row::end_state + span.to + k], group[span.from + k]);
  assign_where(ending, group[row::ended], V(double(job.at[g])));
  alive = alive && !ending;
}

// Return the part of the momenta (6) of a group that thrust does not explain.
static void unexplained(const V *group, V *to) {
  for (int k = 0; k < 6; ++k) to[k] = group[row::momentum + k] - group[EXPECTED_ROW + k];
}

static void watch_momenta(V *group, V alive) {
  V now[6];
  unexplained(group, now);
  for (int part = 0; part < 2; ++part) {
    V square(0.0);
    for (int k = 3 * part; k < 3 * part + 3; ++k) {
      const V change = now[k] - group[row::first_momenta + k];
      square += change * change;
    }
    V &drift = group[row::drift + part];
    assign_where(alive, drift, fmax(drift, sqrt(square)));
  }
}
#endif

static void commit(const Job &job, long long g, V *group) {
  const V alive = group[row::alive];
  for (const Span &span : SUMS)
    for (long long k = 0; k < span.count; ++k)
      group[span.to + k] += group[span.from + k] * alive;
  for (const Span &span : PEAKS)
    for (long long k = 0; k < span.count; ++k) {
      V &peak = group[span.to + k];
      assign_where(alive, peak, fmax(peak, fabs(group[span.from + k])));
    }
#ifdef STOP_ROW
  for (int part = 0; part < 2; ++part) {
    const V *w = group + REALISED_ROW + JOINTS + 3 * part;
    const V size = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
    V &peak = group[row::peak_wrench + part];
    assign_where(alive, peak, fmax(peak, size));
  }
#endif
  for (const Span &span : COPIES)
    for (long long k = 0; k < span.count; ++k) group[span.to + k] = group[span.from + k];
  for (long long k = 0; k < JOINTS; ++k) {
    V &lowest = group[row::lowest + k], &highest = group[row::highest + k];
    assign_where(alive, lowest, fmin(lowest, group[row::state + k]));
    assign_where(alive, highest, fmax(highest, group[row::state + k]));
  }
  job.at[g] += 1;
  record(job, g, job.at[g], group);
#ifdef CONTROL
  watch_momenta(group, alive);
  if (job.ends) end_where(job, g, group, group[row::decision]);
#endif
}

#ifdef STOP_ROW
#ifdef HOLDING_STEP
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

// Give the rates after impulses that bring some joints to rest, and the impulses. `after` may be
// `rates`.
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
        stop_joints(compliance, rates, touched, rates, impulses);
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
#endif

// Repeat the tick of the lanes where a joint touches a stop. Those that cannot continue fail.
static void apply_stops(const Job &job, long long g, V *group, bool report) {
  V lanes = group[STOP_ROW] != V(0.0) && group[row::alive];
  if (!any(lanes)) return;
#ifdef HOLDING_STEP
  Stops stops{group, job.period / SUBSTEPS};
  const V failed = stops.advance(job.period, lanes);
#else
  const V failed = lanes;
#endif
  assign_where(failed, group[row::failure], failed);
  assign_where(failed, group[row::failed_at], V(double(job.at[g])));
  group[row::alive] = group[row::alive] && !failed;
#ifdef HOLDING_STEP
  lanes = lanes && !failed;
  // A tick of no duration gives the results at the state after the stops.
  for (int k = 0; k < STATE; ++k) assign_where(lanes, group[row::state + k], stops.x[k]);
  assign_where(lanes, group[row::h], V(0.0));
  evaluate(group, report);
  assign_where(lanes, group[row::h], V(job.period));
  for (int lane = 0; lane < LANES; ++lane)
    for (int j = 0; lanes.x[lane] != 0.0 && j < JOINTS; ++j)
      group[row::limits + JOINTS + j].x[lane] += in(stops.stopped[lane], j);
#endif
}
#endif

// Evaluate the report of a group at its state, and record it if the start is an instant. Groups in
// which all ticks have a duration are under way.
static void start(const Job &job, long long g, V *group) {
  if (!any(group[row::h] == V(0.0))) return;
  evaluate(group, true);
  record(job, g, 0, group);
  for (long long k = 0; k < JOINTS; ++k)
    group[row::lowest + k] = group[row::highest + k] = group[row::state + k];
#ifdef CONTROL
  unexplained(group, group + row::first_momenta);
#endif
}

// Fly a group until a tick, or until lanes need Python for a command: the group is then pending.
static void fly(const Job &job, long long g, V *group) {
  while (job.at[g] < job.until && any(group[row::alive])) {
    const long long tick = job.at[g];
#ifdef CONTROL
    const bool report = true;
    if (!job.pending[g] && control(job, g, tick, group)) {
      job.pending[g] = 1;
      return;
    }
    job.pending[g] = 0;
#else
    const bool report = instant_of(job, tick + 1) >= 0;
    command(job, g, tick, group);
#endif
    evaluate(group, report);
#ifdef STOP_ROW
    apply_stops(job, g, group, report);
#endif
    commit(job, g, group);
  }
}

#ifdef THREADS
// Work on a flight in memory of its thread.
template <class Work>
static void one_flight(const Job &job, long long g, Work work) {
  V group[ROWS];
  for (int k = 0; k < ROWS; ++k) group[k] = job.memory[place(job, g, ROWS, k)];
  work(g, group);
  for (int k = 0; k < ROWS; ++k) job.memory[place(job, g, ROWS, k)] = group[k];
}
#endif

template <class Work>
static void each_group(const Job &job, Work work) {
#ifdef __CUDACC_RTC__
  const long long g = blockIdx.x * (long long)blockDim.x + threadIdx.x;
  if (g < job.groups) one_flight(job, g, work);
#else
  for (long long g = 0; g < job.groups; ++g)
#ifdef THREADS
    one_flight(job, g, work);
#else
    work(g, job.memory + g * ROWS);
#endif
#endif
}

#ifdef __CUDACC_RTC__
#define ENTRY_POINT extern "C" __global__ void
#else
#define ENTRY_POINT extern "C" void
#endif

ENTRY_POINT start_flights(const Job *job) {
  each_group(*job, [=](long long g, V *group) { start(*job, g, group); });
}

ENTRY_POINT fly_until(const Job *job) {
  each_group(*job, [=](long long g, V *group) { fly(*job, g, group); });
}

#ifdef CONTROL
ENTRY_POINT measure_starts(const Job *job) {
  each_group(*job, [=](long long g, V *group) { measure_start(*job, g, group); });
}

ENTRY_POINT end_flights(const Job *job) {
  each_group(*job, [=](long long g, V *group) { end_where(*job, g, group, V(1.0)); });
}
#endif
