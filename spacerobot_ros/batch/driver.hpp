// Flies groups of flights, one in each lane, tick by tick. What follows LANES numbers that belong
// together is called a row; a group's memory is a table of rows, the same for all groups.
//
// FLIGHT and REPORT are CasADi's functions of a tick: the latter also gives what is reported.
// CONTROL, where there is one, gives the command for a state.

struct Span {
  long long from, to, count;  // rows
};

enum Program { HELD = 0, FOLLOWED = 1, CONTROLLED = 2 };

enum Decision { NONE = 0, REACHED = 1, FAILED = 2, LOST = 3 };  // about the goal of a controller

enum Pending { NOTHING = 0, COMMIT = 1, TICK = 2, FIRE = 3 };

struct Job {
  V *memory;               // groups x rows
  long long groups, rows;
  long long *at;           // of each group: the tick that is next
  unsigned char *pending;  // of each group: what is next is to commit a tick, or to take it
  // Arguments and results of the two functions: rows, in the order of CasADi.
  const long long *arguments, *flight_results, *report_results;
  long long argument_count, flight_result_count, report_result_count;
  // After each tick.
  const Span *copies, *sums, *peaks;
  long long copy_count, sum_count, peak_count;
  long long stop_row;      // where lanes are not zero the tick is to be taken otherwise; -1: none
  long long alive_row;     // 1 in lanes that still fly
  // Force and torque on the base: rows of the wrench, of two peaks and two impulses; -1: none.
  long long wrench_row, wrench_peak_row, impulse_row;
  double period;
  long long period_ns;
  // Commands.
  long long program, command_row, command_count;
  const double *table;     // (ticks, command_count), or with each_table (groups, ticks, count, LANES)
  long long table_ticks, each_table;
  // FOLLOWED: the table has shapes, and one more of them than ticks.
  long long q_row, measured_row, bias_row, noise_row, n, noisy;
  const double *normals;   // (groups, ticks from normals_from on, normals_width, LANES)
  long long normals_from, normals_ticks, normals_width;
  double gain, deadband;
  // Reports.
  const long long *instants;  // ticks, ascending
  long long instant_count;
  V *reports;              // (groups, instants, report rows)
  const Span *reported;
  long long reported_count, report_rows;
  // CONTROLLED: rows of CONTROL's arguments and results, and those that the loop looks at.
  const long long *control_arguments, *control_results;
  long long control_argument_count, control_result_count;
  long long normals_row, time_row, since_row, begun_row, exact_row, settled_row, reached_row;
  V *reached;              // (groups, report rows): the state when a goal was reached
  long long lowest_row, highest_row;  // of the joint positions
  // CONTROLLED: what is decided about goals, when, and with which errors; whether flights then end.
  long long wild_row, wild_count_row, errors_row, decision_row, decided_row, decided_errors_row;
  long long lost_states, last_tick, ends, ended_row;
  V *ended;                // (groups, report rows): the state at the end
  // CONTROLLED: momenta as they are and as thrust explains them; the largest change of either.
  long long momentum_row, expected_row, first_momenta_row, drift_row;
  // Thrusters: by thruster what is solved for it (7) and its wrench (6); weights (6) of a wrench;
  // shortest pulses, s, and flows, kg/s. Rows of the wanted wrench and of the modulation.
  const double *thruster_matrix, *thruster_wrenches, *thruster_weights;
  const double *thruster_shortest, *thruster_flow;
  long long wanted_row, owed_row, left_row, on_row, levels_row, unallocated_row, propellant_row;
};

static bool any(V flags) {
  for (int lane = 0; lane < LANES; ++lane)
    if (flags.x[lane] != 0.0) return true;
  return false;
}

INLINE void assign_where(V flag, V &to, V value) { to.x = flag.x != 0.0 ? value.x : to.x; }

static V *work_memory() {
  static thread_local V *memory = nullptr;
  if (!memory) memory = (V *)aligned_alloc(64, ((WORK_SIZE * sizeof(V)) / 64 + 1) * 64);
  return memory;
}

typedef int Function(const V **, V **, long long *, V *, int);

static void call(Function *function, V *group, const long long *arguments, long long argument_count,
                 const long long *results, long long result_count) {
  const V *in[ARGUMENT_POINTERS];
  V *out[RESULT_POINTERS];
  static thread_local long long integers[INTEGER_SIZE];
  for (long long i = 0; i < argument_count; ++i) in[i] = group + arguments[i];
  for (long long i = 0; i < result_count; ++i) out[i] = group + results[i];
  function(in, out, integers, work_memory(), 0);
}

static void evaluate(const Job &job, V *group, bool report) {
  if (report)
    call(REPORT, group, job.arguments, job.argument_count, job.report_results,
         job.report_result_count);
  else
    call(FLIGHT, group, job.arguments, job.argument_count, job.flight_results,
         job.flight_result_count);
}

static long long instant_of(const Job &job, long long tick) {
  for (long long i = 0; i < job.instant_count; ++i)
    if (job.instants[i] == tick) return i;
  return -1;
}

// Copy what is reported of the state of a group, in the lanes where a flag is not zero.
static void copy_report(const Job &job, long long g, V *to, V chosen) {
  const V *group = job.memory + g * job.rows;
  const Bits mask = chosen.x != 0.0;
  for (long long i = 0; i < job.reported_count; ++i)
    for (long long k = 0; k < job.reported[i].count; ++k) {
      Numbers &there = to[job.reported[i].to + k].x;
      there = mask ? group[job.reported[i].from + k].x : there;
    }
}

static void record(const Job &job, long long g, long long tick) {
  const long long instant = instant_of(job, tick);
  if (instant >= 0)
    copy_report(job, g, job.reports + (g * job.instant_count + instant) * job.report_rows, V(1.0));
}

static V normal(const Job &job, long long g, long long tick, long long column) {
  const double *each =
      job.normals +
      ((g * job.normals_ticks + tick - job.normals_from) * job.normals_width + column) * LANES;
  Numbers numbers;
  for (int lane = 0; lane < LANES; ++lane) numbers[lane] = each[lane];
  return V(numbers);
}

static void measure(const Job &job, long long g, long long tick, V *group) {
  V *measured = group + job.measured_row;
  const V *q = group + job.q_row, *bias = group + job.bias_row;
  if (!job.noisy) {
    for (long long j = 0; j < job.n; ++j) measured[j] = q[j];
    return;
  }
  for (long long j = 0; j < job.n; ++j)
    measured[j] = q[j] + bias[j] + group[job.noise_row] * normal(job, g, tick, j);
}

static V entry(const Job &job, long long g, long long tick, long long column) {
  if (!job.each_table) return V(job.table[tick * job.command_count + column]);
  const double *each =
      job.table + ((g * job.table_ticks + tick) * job.command_count + column) * LANES;
  Numbers numbers;
  for (int lane = 0; lane < LANES; ++lane) numbers[lane] = each[lane];
  return V(numbers);
}

static void command(const Job &job, long long g, long long tick, V *group) {
  V *to = group + job.command_row;
  if (job.program == HELD) {
    for (long long j = 0; j < job.command_count; ++j)
      to[j] = tick < job.table_ticks ? entry(job, g, tick, j) : V(0.0);
    return;
  }
  measure(job, g, tick, group);
  const V *measured = group + job.measured_row;
  const long long last = job.table_ticks - 1, k = tick < last ? tick : last;
  const V gain(job.gain), band(job.deadband);
  for (long long j = 0; j < job.command_count; ++j) {
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

#include "thrusters.hpp"

#ifdef CONTROL
// Decide about the goals of a group, by the errors of the command at a tick.
static void decide(const Job &job, long long tick, V *group) {
  V lost(0.0);
  for (int kind = 0; kind < 2; ++kind) {
    V &count = group[job.wild_count_row + kind];
    count = group[job.wild_row + kind] * (count + V(1.0));
    lost = lost || count >= V(double(job.lost_states));
  }
  V &decision = group[job.decision_row];
  V made(job.last_tick >= 0 && tick >= job.last_tick ? double(FAILED) : double(NONE));
  assign_where(group[job.settled_row], made, V(double(REACHED)));
  assign_where(lost, made, V(double(LOST)));
  const V now = decision == V(double(NONE)) && made && group[job.alive_row];
  if (!any(now)) return;
  assign_where(now, decision, made);
  assign_where(now, group[job.decided_row], V(double(tick)));
  for (int k = 0; k < 3; ++k)
    assign_where(now, group[job.decided_errors_row + k], group[job.errors_row + k]);
}

// Measure the state and evaluate the command for it; return whether lanes need another one.
static bool control(const Job &job, long long g, long long tick, V *group) {
  for (long long k = 0; job.noisy && k < job.normals_width; ++k)
    group[job.normals_row + k] = normal(job, g, tick, k);
  group[job.time_row] = V(double(tick * job.period_ns) / 1e9);
  call(CONTROL, group, job.control_arguments, job.control_argument_count, job.control_results,
       job.control_result_count);
  group[job.since_row] = group[job.begun_row];
  V &reached = group[job.reached_row];
  const V now = group[job.settled_row] && reached < V(0.0);
  assign_where(now, reached, group[job.time_row]);
  copy_report(job, g, job.reached + g * job.report_rows, now);
  decide(job, tick, group);
  return any(group[job.exact_row] && group[job.alive_row]);
}

// Measure the first state of every group: what references begin from.
extern "C" void measure_starts(const Job *job) {
  for (long long g = 0; g < job->groups; ++g) {
    V *group = job->memory + g * job->rows;
    control(*job, g, 0, group);
    group[job->since_row] = group[job->reached_row] = group[job->decided_row] = V(-1.0);
    group[job->decision_row] = V(double(NONE));
    group[job->wild_count_row] = group[job->wild_count_row + 1] = V(0.0);
  }
}

// End the flights of a group whose goals are decided, after the tick that is committed.
static void end_decided(const Job &job, long long g, V *group) {
  V &alive = group[job.alive_row];
  const V ending = group[job.decision_row] && alive;
  if (!any(ending)) return;
  copy_report(job, g, job.ended + g * job.report_rows, ending);
  assign_where(ending, group[job.ended_row], V(double(job.at[g])));
  alive = alive && !ending;
}

// Return by how much thrust does not explain the momenta (6) of a group.
static void unexplained(const Job &job, const V *group, V *to) {
  for (int k = 0; k < 6; ++k) to[k] = group[job.momentum_row + k] - group[job.expected_row + k];
}

static void watch_momenta(const Job &job, V *group, V alive) {
  V now[6];
  unexplained(job, group, now);
  for (int part = 0; part < 2; ++part) {
    V square(0.0);
    for (int k = 3 * part; k < 3 * part + 3; ++k) {
      const V change = now[k] - group[job.first_momenta_row + k];
      square += change * change;
    }
    V &drift = group[job.drift_row + part];
    assign_where(alive, drift, fmax(drift, sqrt(square)));
  }
}
#endif

static void commit(const Job &job, long long g) {
  V *group = job.memory + g * job.rows;
  const V alive = group[job.alive_row];
  for (long long i = 0; i < job.sum_count; ++i)
    for (long long k = 0; k < job.sums[i].count; ++k)
      group[job.sums[i].to + k] += group[job.sums[i].from + k] * alive;
  for (long long i = 0; i < job.peak_count; ++i)
    for (long long k = 0; k < job.peaks[i].count; ++k) {
      V &peak = group[job.peaks[i].to + k];
      assign_where(alive, peak, fmax(peak, fabs(group[job.peaks[i].from + k])));
    }
  if (job.wrench_row >= 0)
    for (int part = 0; part < 2; ++part) {
      const V *w = group + job.wrench_row + 3 * part;
      const V size = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
      V &peak = group[job.wrench_peak_row + part];
      assign_where(alive, peak, fmax(peak, size));
      V &impulse = group[job.impulse_row + part];
      assign_where(alive, impulse, impulse + V(job.period) * size);
    }
  for (long long i = 0; i < job.copy_count; ++i)
    for (long long k = 0; k < job.copies[i].count; ++k)
      group[job.copies[i].to + k] = group[job.copies[i].from + k];
  for (long long k = 0; k < job.n; ++k) {
    V &lowest = group[job.lowest_row + k], &highest = group[job.highest_row + k];
    assign_where(alive, lowest, fmin(lowest, group[job.q_row + k]));
    assign_where(alive, highest, fmax(highest, group[job.q_row + k]));
  }
  job.at[g] += 1;
  job.pending[g] = NOTHING;
  record(job, g, job.at[g]);
#ifdef CONTROL
  watch_momenta(job, group, alive);
  if (job.ends) end_decided(job, g, group);
#endif
}

// Evaluate the report of every group at its state, and record it if the start is an instant.
extern "C" void start_flights(const Job *job) {
  for (long long g = 0; g < job->groups; ++g) {
    V *group = job->memory + g * job->rows;
    evaluate(*job, group, true);
    record(*job, g, 0);
    for (long long k = 0; k < job->n; ++k)
      group[job->lowest_row + k] = group[job->highest_row + k] = group[job->q_row + k];
#ifdef CONTROL
    unexplained(*job, group, group + job->first_momenta_row);
#endif
  }
}

// Fly all groups until a tick, or until a lane needs another command or tick than this one; the
// number of groups that wait for that is returned.
extern "C" long long fly_until(const Job *job, long long until) {
  long long waiting = 0;
  for (long long g = 0; g < job->groups; ++g) {
    V *group = job->memory + g * job->rows;
    if (job->pending[g] == COMMIT) commit(*job, g);
    while (job->at[g] < until && any(group[job->alive_row])) {
      const long long tick = job->at[g];
#ifdef CONTROL
      if (job->pending[g] != TICK && job->pending[g] != FIRE && control(*job, g, tick, group)) {
        job->pending[g] = TICK;
        ++waiting;
        break;
      }
#if THRUSTERS > 0
      if (job->pending[g] != FIRE && allocate(*job, group)) {
        job->pending[g] = FIRE;
        ++waiting;
        break;
      }
      fire(*job, group);
#endif
      job->pending[g] = NOTHING;
      evaluate(*job, group, true);
#else
      command(*job, g, tick, group);
      evaluate(*job, group, instant_of(*job, tick + 1) >= 0);
#endif
      if (job->stop_row >= 0) {
        if (any((group[job->stop_row] != V(0.0)) && group[job->alive_row])) {
          job->pending[g] = COMMIT;
          ++waiting;
          break;
        }
      }
      commit(*job, g);
    }
  }
  return waiting;
}

// CasADi's interface with a number for each V: for the trial of a new object.
static int trial(Function *function, const long long *sizes_in, long long count_in,
                 const long long *sizes_out, long long count_out,
                 const double **arguments, double **results) {
  const V *in[ARGUMENT_POINTERS];
  V *out[RESULT_POINTERS];
  static V memory[TRIAL_SIZE];
  static long long integers[INTEGER_SIZE];
  V *next = memory;
  for (long long i = 0; i < count_in; ++i) {
    in[i] = next;
    for (long long k = 0; k < sizes_in[i]; ++k) *next++ = V(arguments[i][k]);
  }
  for (long long i = 0; i < count_out; ++i) {
    out[i] = next;
    next += sizes_out[i];
  }
  const int code = function(in, out, integers, work_memory(), 0);
  for (long long i = 0; i < count_out; ++i)
    for (long long k = 0; k < sizes_out[i]; ++k) {
      results[i][k] = out[i][k].x[0];
      for (int lane = 1; lane < LANES; ++lane)
        if (out[i][k].x[lane] != out[i][k].x[0]) results[i][k] = HUGE_VAL;
    }
  return code;
}
