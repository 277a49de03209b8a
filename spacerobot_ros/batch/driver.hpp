// Flies groups of flights, one in each lane, tick by tick. What follows LANES numbers that belong
// together is called a row; a group's memory is a table of rows, the same for all groups.
//
// FLIGHT and REPORT are CasADi's functions of a tick: the latter also gives what is reported.

struct Span {
  long long from, to, count;  // rows
};

enum Program { HELD = 0, FOLLOWED = 1 };

struct Job {
  V *memory;               // groups x rows
  long long groups, rows;
  long long *at;           // of each group: the tick that is next
  unsigned char *pending;  // of each group: a tick was taken, and is to be committed
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
  // Commands.
  long long program, command_row, command_count;
  const double *table;     // (ticks, command_count), or with each_table (groups, ticks, count, LANES)
  long long table_ticks, each_table;
  // FOLLOWED: the table has shapes, and one more of them than ticks.
  long long q_row, measured_row, bias_row, noise_row, n, noisy;
  const double *normals;   // (groups, ticks from normals_from on, n, LANES)
  long long normals_from, normals_ticks;
  double gain, deadband;
  // Reports.
  const long long *instants;  // ticks, ascending
  long long instant_count;
  V *reports;              // (groups, instants, report rows)
  const Span *reported;
  long long reported_count, report_rows;
};

static V *work_memory() {
  static thread_local V *memory = nullptr;
  if (!memory) memory = (V *)aligned_alloc(64, ((WORK_SIZE * sizeof(V)) / 64 + 1) * 64);
  return memory;
}

static void evaluate(const Job &job, V *group, bool report) {
  const V *arguments[ARGUMENT_POINTERS];
  V *results[RESULT_POINTERS];
  static thread_local long long integers[INTEGER_SIZE];
  const long long count = report ? job.report_result_count : job.flight_result_count;
  const long long *rows = report ? job.report_results : job.flight_results;
  for (long long i = 0; i < job.argument_count; ++i) arguments[i] = group + job.arguments[i];
  for (long long i = 0; i < count; ++i) results[i] = rows[i] < 0 ? nullptr : group + rows[i];
  (report ? REPORT : FLIGHT)(arguments, results, integers, work_memory(), 0);
}

static long long instant_of(const Job &job, long long tick) {
  for (long long i = 0; i < job.instant_count; ++i)
    if (job.instants[i] == tick) return i;
  return -1;
}

static void record(const Job &job, long long g, long long tick) {
  const long long instant = instant_of(job, tick);
  if (instant < 0) return;
  V *to = job.reports + (g * job.instant_count + instant) * job.report_rows;
  const V *group = job.memory + g * job.rows;
  for (long long i = 0; i < job.reported_count; ++i)
    for (long long k = 0; k < job.reported[i].count; ++k)
      to[job.reported[i].to + k] = group[job.reported[i].from + k];
}

static void measure(const Job &job, long long g, long long tick, V *group) {
  V *measured = group + job.measured_row;
  const V *q = group + job.q_row, *bias = group + job.bias_row;
  if (!job.noisy) {
    for (long long j = 0; j < job.n; ++j) measured[j] = q[j];
    return;
  }
  const double *normals =
      job.normals + (g * job.normals_ticks + tick - job.normals_from) * job.n * LANES;
  for (long long j = 0; j < job.n; ++j) {
    Numbers normal;
    for (int lane = 0; lane < LANES; ++lane) normal[lane] = normals[j * LANES + lane];
    measured[j] = q[j] + bias[j] + group[job.noise_row] * V(normal);
  }
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

static void commit(const Job &job, long long g) {
  V *group = job.memory + g * job.rows;
  for (long long i = 0; i < job.sum_count; ++i)
    for (long long k = 0; k < job.sums[i].count; ++k)
      group[job.sums[i].to + k] += group[job.sums[i].from + k];
  for (long long i = 0; i < job.peak_count; ++i)
    for (long long k = 0; k < job.peaks[i].count; ++k) {
      V &peak = group[job.peaks[i].to + k];
      peak = fmax(peak, fabs(group[job.peaks[i].from + k]));
    }
  if (job.wrench_row >= 0)
    for (int part = 0; part < 2; ++part) {
      const V *w = group + job.wrench_row + 3 * part;
      const V size = sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
      V &peak = group[job.wrench_peak_row + part];
      peak = fmax(peak, size);
      group[job.impulse_row + part] += V(job.period) * size;
    }
  for (long long i = 0; i < job.copy_count; ++i)
    for (long long k = 0; k < job.copies[i].count; ++k)
      group[job.copies[i].to + k] = group[job.copies[i].from + k];
  job.at[g] += 1;
  job.pending[g] = 0;
  record(job, g, job.at[g]);
}

// Evaluate the report of every group at its state, and record it if the start is an instant.
extern "C" void start_flights(const Job *job) {
  for (long long g = 0; g < job->groups; ++g) {
    evaluate(*job, job->memory + g * job->rows, true);
    record(*job, g, 0);
  }
}

// Fly all groups until a tick, or until a lane needs another tick than this one; the number of
// groups that stopped for that is returned, their ticks pending.
extern "C" long long fly_until(const Job *job, long long until) {
  long long stopped = 0;
  for (long long g = 0; g < job->groups; ++g) {
    V *group = job->memory + g * job->rows;
    if (job->pending[g]) commit(*job, g);
    while (job->at[g] < until) {
      const long long tick = job->at[g];
      command(*job, g, tick, group);
      evaluate(*job, group, instant_of(*job, tick + 1) >= 0);
      if (job->stop_row >= 0) {
        const V stop = (group[job->stop_row] != V(0.0)) * group[job->alive_row];
        bool any = false;
        for (int lane = 0; lane < LANES; ++lane) any = any || stop.x[lane] != 0.0;
        if (any) {
          job->pending[g] = 1;
          ++stopped;
          break;
        }
      }
      commit(*job, g);
    }
  }
  return stopped;
}

// CasADi's interface with a number for each V: for the trial of a new object.
static int trial(int (*function)(const V **, V **, long long *, V *, int), const long long *sizes_in,
                 long long count_in, const long long *sizes_out, long long count_out,
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
