/* Runs the operations of a CasADi function at many places at once: each operation in a few of the
 * processor's vector registers, then the next one. So an operation is read once for many places.
 * The numbers are those of CasADi's virtual machine, bit for bit: the operations and their order are
 * the same, and nothing is contracted.
 */

#include <math.h>
#include <stdlib.h>

/* The numbers in a register of the processor: more would go through memory. */
#ifndef GROUP
#define GROUP 2
#endif

/* The most registers for which an operation is read once: with more, less memory is in the cache. */
#define MOST_REGISTERS 4

typedef double Vector __attribute__((vector_size(GROUP * sizeof(double))));

/* An operation: its number in CasADi, its result, and its operands: places of the memory, or for
 * inputs and outputs the number of the argument and the place in it. */
typedef struct {
  int operation, result, first, second;
} Step;

/* The numbers of all places: `sizes` are the nonzeros at a place, which stand together. */
typedef struct {
  const double *const *arguments;
  const long long *argument_sizes;
  double *const *results;
  const long long *result_sizes;
} Numbers;

#define OF_REGISTERS(EXPRESSION)               \
  _Pragma("GCC unroll 4")                      \
  for (r = 0; r < registers; ++r) {            \
    const Vector x = a[r], y = b[r];           \
    (void)y;                                   \
    c[r] = (EXPRESSION);                       \
  }                                            \
  break;

#define OF_EACH(EXPRESSION)                    \
  for (i = 0; i < count; ++i) {                \
    const double x = a[i], y = b[i];           \
    (void)y;                                   \
    c[i] = (EXPRESSION);                       \
  }                                            \
  break;

/* Computes an operation number by number: a rare one, or one that registers do not have. */
static __attribute__((noinline)) void run_one_by_one(int operation, const double *a,
                                                     const double *b, double *c, int count) {
  int i;
  switch (operation) {
    case SQRT: OF_EACH(sqrt(x))
    case SIN: OF_EACH(sin(x))
    case COS: OF_EACH(cos(x))
    case TAN: OF_EACH(tan(x))
    case ASIN: OF_EACH(asin(x))
    case ACOS: OF_EACH(acos(x))
    case ATAN: OF_EACH(atan(x))
    case ATAN2: OF_EACH(atan2(x, y))
    case EXP: OF_EACH(exp(x))
    case LOG: OF_EACH(log(x))
    case POW: OF_EACH(pow(x, y))
    case CONSTPOW: OF_EACH(pow(x, y))
    case TANH: OF_EACH(tanh(x))
    case FLOOR: OF_EACH(floor(x))
    case CEIL: OF_EACH(ceil(x))
    case FABS: OF_EACH(fabs(x))
    case FMIN: OF_EACH(fmin(x, y))
    case FMAX: OF_EACH(fmax(x, y))
    case LT: OF_EACH(x < y ? 1.0 : 0.0)
    case LE: OF_EACH(x <= y ? 1.0 : 0.0)
    case EQ: OF_EACH(x == y ? 1.0 : 0.0)
    case NE: OF_EACH(x != y ? 1.0 : 0.0)
    case NOT: OF_EACH(x == 0.0 ? 1.0 : 0.0)
    case AND: OF_EACH(x != 0.0 && y != 0.0 ? 1.0 : 0.0)
    case OR: OF_EACH(x != 0.0 || y != 0.0 ? 1.0 : 0.0)
    case IF_ELSE_ZERO: OF_EACH(x != 0.0 ? y : 0.0)
    case SIGN: OF_EACH(x < 0.0 ? -1.0 : x > 0.0 ? 1.0 : x)
    case COPYSIGN: OF_EACH(copysign(x, y))
  }
}

/* Runs all operations at `count` places from `begin` on, at most `registers * GROUP`. */
static inline __attribute__((always_inline)) void run_in_registers(
    const Step *steps, long long step_count, const double *constants, Vector *memory,
    const Numbers *numbers, long long begin, int count, const int registers) {
  long long k;
  int i, r;
  for (k = 0; k < step_count; ++k) {
    const Step s = steps[k];
    const Vector *a = memory + (long long)s.first * registers;
    const Vector *b = memory + (long long)s.second * registers;
    Vector *c = memory + (long long)s.result * registers;
    switch (s.operation) {
      case INPUT: {
        const long long size = numbers->argument_sizes[s.first];
        const double *from = numbers->arguments[s.first] + begin * size + s.second;
        double *to = (double *)c;
        for (i = 0; i < count; ++i) to[i] = from[i * size];
        for (; i < registers * GROUP; ++i) to[i] = to[count - 1];
        break;
      }
      case OUTPUT: {
        const long long size = numbers->result_sizes[s.result];
        double *to = numbers->results[s.result];
        to += begin * size + s.second;
        for (i = 0; i < count; ++i) to[i * size] = ((const double *)a)[i];
        break;
      }
      case CONST:
        for (i = 0; i < registers * GROUP; ++i) ((double *)c)[i] = constants[s.first];
        break;
      case ASSIGN: OF_REGISTERS(x)
      case ADD: OF_REGISTERS(x + y)
      case SUB: OF_REGISTERS(x - y)
      case MUL: OF_REGISTERS(x * y)
      case DIV: OF_REGISTERS(x / y)
      case NEG: OF_REGISTERS(-x)
      case SQ: OF_REGISTERS(x * x)
      case TWICE: OF_REGISTERS(2.0 * x)
      case INV: OF_REGISTERS(1.0 / x)
      default:
        run_one_by_one(s.operation, (const double *)a, (const double *)b, (double *)c,
                       registers * GROUP);
    }
  }
}

/* Returns 0, or 1 where memory is short. `sizes` are the nonzeros of the arguments and results at a
 * place; the numbers of a place stand together. */
int run_at_places(const Step *steps, long long step_count, const double *constants,
                  long long memory_size, const double *const *arguments,
                  const long long *argument_sizes, double *const *results,
                  const long long *result_sizes, long long places) {
  const Numbers numbers = {arguments, argument_sizes, results, result_sizes};
  const size_t size = (size_t)(memory_size + 1) * MOST_REGISTERS * sizeof(Vector);
  void *block = malloc(size + sizeof(Vector));
  Vector *memory;
  long long begin = 0;
  if (!block) return 1;
  memory = (Vector *)(((size_t)block + sizeof(Vector) - 1) / sizeof(Vector) * sizeof(Vector));
  while (begin < places) {
    const long long left = places - begin;
    const int registers = left > GROUP ? MOST_REGISTERS : 1;
    const int count = left < registers * GROUP ? (int)left : registers * GROUP;
    /* The compiler makes a program for either number of registers. */
#define RUN(REGISTERS) \
  run_in_registers(steps, step_count, constants, memory, &numbers, begin, count, REGISTERS)
    if (registers == MOST_REGISTERS) RUN(MOST_REGISTERS);
    else RUN(1);
    begin += count;
  }
  free(block);
  return 0;
}
