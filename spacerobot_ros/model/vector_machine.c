/* Runs the operations of a CasADi function at many places at once: each operation at GROUP places,
 * then the next one. So an operation is read once for all of them, and computed in vector registers.
 * The numbers are those of CasADi's virtual machine, bit for bit: the operations and their order are
 * the same, and nothing is contracted.
 */

#include <math.h>
#include <stdlib.h>

/* The numbers in a register of the processor: more would go through memory. */
#ifndef GROUP
#define GROUP 2
#endif

typedef double Vector __attribute__((vector_size(GROUP * sizeof(double))));

/* An operation: its number in CasADi, its result, and its operands: places of the memory, or for
 * inputs and outputs the number of the argument and the place in it. */
typedef struct {
  int operation, result, first, second;
} Step;

#define OF_ALL(EXPRESSION)                     \
  for (i = 0; i < GROUP; ++i) {                \
    const double x = a[i], y = b[i];           \
    (void)y;                                   \
    c[i] = (EXPRESSION);                       \
  }                                            \
  break;

/* Returns 0, or 1 where memory is short. `sizes` are the nonzeros of the arguments and results at a
 * place; the numbers of a place stand together. Results may be NULL. */
int run_at_places(const Step *steps, long long step_count, const double *constants,
                  long long memory_size, const double *const *arguments,
                  const long long *argument_sizes, double *const *results,
                  const long long *result_sizes, long long places) {
  void *block = malloc((size_t)(memory_size + 1) * sizeof(Vector) + sizeof(Vector));
  Vector *memory;
  long long begin, k;
  int i;
  if (!block) return 1;
  memory = (Vector *)(((size_t)block + sizeof(Vector) - 1) / sizeof(Vector) * sizeof(Vector));
  for (begin = 0; begin < places; begin += GROUP) {
    const int count = places - begin < GROUP ? (int)(places - begin) : GROUP;
    for (k = 0; k < step_count; ++k) {
      const Step s = steps[k];
      if (s.operation == INPUT) {
        const long long size = argument_sizes[s.first];
        const double *from = arguments[s.first] + begin * size + s.second;
        double *c = (double *)&memory[s.result];
        for (i = 0; i < count; ++i) c[i] = from[i * size];
        for (; i < GROUP; ++i) c[i] = c[count - 1];
        continue;
      }
      if (s.operation == OUTPUT) {
        const long long size = result_sizes[s.result];
        const double *c = (const double *)&memory[s.first];
        double *to = results[s.result];
        if (!to) continue;
        to += begin * size + s.second;
        for (i = 0; i < count; ++i) to[i * size] = c[i];
        continue;
      }
      if (s.operation == CONST) {
        double *c = (double *)&memory[s.result];
        for (i = 0; i < GROUP; ++i) c[i] = constants[s.first];
        continue;
      }
      {
        const Vector a = memory[s.first], b = memory[s.second];
        Vector c = a;
        switch (s.operation) {
          case ASSIGN: break;
          case ADD: c = a + b; break;
          case SUB: c = a - b; break;
          case MUL: c = a * b; break;
          case DIV: c = a / b; break;
          case NEG: c = -a; break;
          case SQ: c = a * a; break;
          case TWICE: c = 2.0 * a; break;
          case INV: c = 1.0 / a; break;
          case SQRT: OF_ALL(sqrt(x))
          case SIN: OF_ALL(sin(x))
          case COS: OF_ALL(cos(x))
          case TAN: OF_ALL(tan(x))
          case ASIN: OF_ALL(asin(x))
          case ACOS: OF_ALL(acos(x))
          case ATAN: OF_ALL(atan(x))
          case ATAN2: OF_ALL(atan2(x, y))
          case EXP: OF_ALL(exp(x))
          case LOG: OF_ALL(log(x))
          case POW: OF_ALL(pow(x, y))
          case CONSTPOW: OF_ALL(pow(x, y))
          case TANH: OF_ALL(tanh(x))
          case FLOOR: OF_ALL(floor(x))
          case CEIL: OF_ALL(ceil(x))
          case FABS: OF_ALL(fabs(x))
          case FMIN: OF_ALL(fmin(x, y))
          case FMAX: OF_ALL(fmax(x, y))
          case LT: OF_ALL(x < y ? 1.0 : 0.0)
          case LE: OF_ALL(x <= y ? 1.0 : 0.0)
          case EQ: OF_ALL(x == y ? 1.0 : 0.0)
          case NE: OF_ALL(x != y ? 1.0 : 0.0)
          case NOT: OF_ALL(x == 0.0 ? 1.0 : 0.0)
          case AND: OF_ALL(x != 0.0 && y != 0.0 ? 1.0 : 0.0)
          case OR: OF_ALL(x != 0.0 || y != 0.0 ? 1.0 : 0.0)
          case IF_ELSE_ZERO: OF_ALL(x != 0.0 ? y : 0.0)
          case SIGN: OF_ALL(x < 0.0 ? -1.0 : x > 0.0 ? 1.0 : x)
          case COPYSIGN: OF_ALL(copysign(x, y))
        }
        memory[s.result] = c;
      }
    }
  }
  free(block);
  return 0;
}
