/* Distances of pairs of links as smooth functions of the shape, with first and second derivatives:
 * the formulas of rows.py, derived by hand.
 *
 * A point of one link, seen from a field in the other one, is the end of a chain of joints from the
 * field to the point. With the twist S_i = (v_i, w_i) of joint i in the frame of the field, the point
 * x moves at dx/dq_i = v_i + w_i x x, and, with joint i nearer to the field than joint j,
 * d2x/dq_i dq_j = w_i x dx/dq_j. As all balls of a link move with the same twists, sums over the balls
 * are taken before the joints are looked at: they are 6 numbers for the gradient, a 6 x 6 matrix and a
 * 3 x 3 one for the Hessian.
 *
 * Before this text stand JOINTS, MOST_STEPS, MOST_BALLS, SHARPNESS_OF_MINIMUM, SHARPNESS_OF_FACES,
 * SQUARE_ROOT_OFFSET, and the tables PAIRS, ROLES, STEPS and BALLS of the structures below.
 */

/* Logarithm of a weight beside 1 that counts for nothing in a double. */
#define LEAST_LOGARITHM -42.0

/* Values of the field at a point, its gradient and Hessian. */
typedef struct {
  double value, gradient[3], hessian[3][3];
} Field;

/* The chain of a role at one shape: pose of the balls' link, and the twists of the joints. */
typedef struct {
  double R[9], r[3], linear[MOST_STEPS][3], angular[MOST_STEPS][3];
} Chain;

static void cross(const double *a, const double *b, double *c) {
  c[0] = a[1] * b[2] - a[2] * b[1];
  c[1] = a[2] * b[0] - a[0] * b[2];
  c[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double *a, const double *b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* y = R x; matrices have one row after the other. */
static void rotate(const double *R, const double *x, double *y) {
  int i;
  for (i = 0; i < 3; ++i) y[i] = dot(R + 3 * i, x);
}

/* Moves a pose (R, r) on by a pose (S, s) that is given in it. */
static void append(double *R, double *r, const double *S, const double *s) {
  double moved[3], turned[9];
  int i, j;
  rotate(R, s, moved);
  for (i = 0; i < 3; ++i) r[i] += moved[i];
  for (i = 0; i < 3; ++i)
    for (j = 0; j < 3; ++j)
      turned[3 * i + j] = R[3 * i] * S[j] + R[3 * i + 1] * S[3 + j] + R[3 * i + 2] * S[6 + j];
  for (i = 0; i < 9; ++i) R[i] = turned[i];
}

/* The rotation about a unit axis (Rodrigues). */
static void about(const double *axis, double angle, double *R) {
  const double c = cos(angle), s = sin(angle), x = axis[0], y = axis[1], z = axis[2], k = 1 - c;
  R[0] = c + k * x * x;     R[1] = k * x * y - s * z; R[2] = k * x * z + s * y;
  R[3] = k * x * y + s * z; R[4] = c + k * y * y;     R[5] = k * y * z - s * x;
  R[6] = k * x * z - s * y; R[7] = k * y * z + s * x; R[8] = c + k * z * z;
}

static void follow(const Role *role, const double *q, Chain *chain) {
  const double none[3] = {0, 0, 0}, unit[9] = {1, 0, 0, 0, 1, 0, 0, 0, 1};
  int i, k;
  for (i = 0; i < 9; ++i) chain->R[i] = role->R[i];
  for (i = 0; i < 3; ++i) chain->r[i] = role->r[i];
  for (k = 0; k < role->steps; ++k) {
    const Step *step = STEPS + role->first_step + k;
    const double by = step->factor * q[step->joint] + step->offset;
    double axis[3], moved[3], turned[9];
    rotate(chain->R, step->axis, axis);
    for (i = 0; i < 3; ++i) {
      moved[i] = by * step->axis[i];
      chain->angular[k][i] = step->slides ? 0 : step->factor * axis[i];
    }
    if (step->slides) {
      for (i = 0; i < 3; ++i) chain->linear[k][i] = step->factor * axis[i];
      append(chain->R, chain->r, unit, moved);
    } else {
      cross(chain->r, chain->angular[k], chain->linear[k]);
      about(step->axis, by, turned);
      append(chain->R, chain->r, turned, none);
    }
    append(chain->R, chain->r, step->R, step->r);
  }
}

static double weight(double logarithm) {
  return logarithm < LEAST_LOGARITHM ? 0 : exp(logarithm);
}

/* About the distance from the axis of a rod. */
static void from_rod(const Role *role, const double *x, Field *field) {
  double beyond[3], active[3], sum = SQUARE_ROOT_OFFSET;
  int i, j;
  for (i = 0; i < 3; ++i) {
    const double half = role->half[i], over = fabs(x[i]) - half;
    active[i] = half == 0 || over > 0;
    beyond[i] = half == 0 ? x[i] : (over > 0 ? (x[i] < 0 ? -over : over) : 0);
    sum += beyond[i] * beyond[i];
  }
  field->value = sqrt(sum);
  for (i = 0; i < 3; ++i) field->gradient[i] = beyond[i] / field->value;
  for (i = 0; i < 3; ++i)
    for (j = 0; j < 3; ++j)
      field->hessian[i][j] =
          ((i == j ? active[i] : 0) - field->gradient[i] * field->gradient[j]) / field->value;
}

/* The smooth maximum of the distances from the faces of a box. */
static void from_box(const Role *role, const double *x, Field *field) {
  double faces[6], largest, sum = 0;
  int i, j;
  for (i = 0; i < 3; ++i) {
    faces[i] = x[i] - role->half[i];
    faces[i + 3] = -x[i] - role->half[i];
  }
  largest = faces[0];
  for (i = 1; i < 6; ++i) largest = faces[i] > largest ? faces[i] : largest;
  for (i = 0; i < 6; ++i) {
    faces[i] = weight(SHARPNESS_OF_FACES * (faces[i] - largest));
    sum += faces[i];
  }
  field->value = largest + log(sum) / SHARPNESS_OF_FACES;
  for (i = 0; i < 3; ++i) field->gradient[i] = (faces[i] - faces[i + 3]) / sum;
  for (i = 0; i < 3; ++i)
    for (j = 0; j < 3; ++j)
      field->hessian[i][j] =
          SHARPNESS_OF_FACES * ((i == j ? (faces[i] + faces[i + 3]) / sum : 0) -
                                field->gradient[i] * field->gradient[j]);
}

/* Adds the derivatives of one ball with a share: gradient (6,), matrix (6, 6), x gradient' (3, 3). */
static void add_ball(const Field *field, const double *x, double share, double *gradient,
                     double matrix[6][6], double moment[3][3]) {
  /* Columns of [1, -[x] x]: how the point moves with the six numbers of a twist. */
  const double moves[6][3] = {{1, 0, 0},        {0, 1, 0},        {0, 0, 1},
                              {0, -x[2], x[1]}, {x[2], 0, -x[0]}, {-x[1], x[0], 0}};
  double slope[6], bent[6][3];
  int i, j;
  for (i = 0; i < 6; ++i) {
    slope[i] = dot(field->gradient, moves[i]);
    gradient[i] += share * slope[i];
    for (j = 0; j < 3; ++j) bent[i][j] = dot(field->hessian[j], moves[i]);
  }
  for (i = 0; i < 6; ++i)
    for (j = 0; j < 6; ++j)
      matrix[i][j] += share * (dot(moves[i], bent[j]) - SHARPNESS_OF_MINIMUM * slope[i] * slope[j]);
  for (i = 0; i < 3; ++i)
    for (j = 0; j < 3; ++j) moment[i][j] += share * x[i] * field->gradient[j];
}

/* Adds the Hessian of one role, all but the last term, the square of the whole gradient. */
static void add_curvature(const Role *role, const Chain *chain, const double *gradient,
                          double matrix[6][6], double moment[3][3], double by, double *H) {
  const double trace = moment[0][0] + moment[1][1] + moment[2][2];
  int i, j, k, l;
  for (j = 0; j < role->steps; ++j) {
    const double *v = chain->linear[j], *w = chain->angular[j];
    double force[6], swung[3];
    const int column = STEPS[role->first_step + j].joint;
    for (k = 0; k < 6; ++k) {
      force[k] = 0;
      for (l = 0; l < 3; ++l) force[k] += matrix[k][l] * v[l] + matrix[k][l + 3] * w[l];
    }
    cross(v, gradient, swung);
    for (k = 0; k < 3; ++k) swung[k] += dot(moment[k], w) - trace * w[k];
    for (i = 0; i <= j; ++i) {
      const int row = STEPS[role->first_step + i].joint;
      const double *linear = chain->linear[i], *angular = chain->angular[i];
      const double value =
          by * (dot(linear, force) + dot(angular, force + 3) + dot(angular, swung));
      H[row + JOINTS * column] += value;
      if (i != j) H[column + JOINTS * row] += value;
    }
  }
}

/* The distance of a pair; its gradient (JOINTS,) and its Hessian times `by`, unless they are null. */
static double distance(int number, const double *q, double by, double *J, double *H) {
  const Pair *pair = PAIRS + number;
  static const Field zero;
  Chain chains[2];
  double values[2 * MOST_BALLS], points[2 * MOST_BALLS][3], least = INFINITY, sum = 0;
  int i, k, m, count = 0;
  for (k = 0; k < pair->roles; ++k) {
    const Role *role = ROLES + pair->first_role + k;
    follow(role, q, chains + k);
    for (m = 0; m < role->balls; ++m, ++count) {
      Field field = zero;
      rotate(chains[k].R, BALLS[role->first_ball + m], points[count]);
      for (i = 0; i < 3; ++i) points[count][i] += chains[k].r[i];
      (role->rod ? from_rod : from_box)(role, points[count], &field);
      values[count] = field.value - role->radii;
      if (values[count] < least) least = values[count];
    }
  }
  for (m = 0; m < count; ++m) {
    values[m] = weight(-SHARPNESS_OF_MINIMUM * (values[m] - least));
    sum += values[m];
  }
  if (J) {
    for (i = 0; i < JOINTS; ++i) J[i] = 0;
    for (i = 0; H && i < JOINTS * JOINTS; ++i) H[i] = 0;
    for (k = 0, count = 0; k < pair->roles; ++k) {
      const Role *role = ROLES + pair->first_role + k;
      double gradient[6] = {0}, matrix[6][6] = {{0}}, moment[3][3] = {{0}};
      for (m = 0; m < role->balls; ++m, ++count) {
        Field field = zero;
        if (values[count] == 0) continue;
        (role->rod ? from_rod : from_box)(role, points[count], &field);
        add_ball(&field, points[count], values[count] / sum, gradient, matrix, moment);
      }
      for (i = 0; i < role->steps; ++i)
        J[STEPS[role->first_step + i].joint] +=
            dot(gradient, chains[k].linear[i]) + dot(gradient + 3, chains[k].angular[i]);
      if (H) add_curvature(role, chains + k, gradient, matrix, moment, by, H);
    }
    for (i = 0; H && i < JOINTS; ++i)
      for (k = 0; k < JOINTS; ++k) H[i + JOINTS * k] += by * SHARPNESS_OF_MINIMUM * J[i] * J[k];
  }
  return least - log(sum) / SHARPNESS_OF_MINIMUM;
}

/* CasADi's interface: (q, pair) -> d; (q, pair) -> dd/dq; (q, pair, lambda) -> lambda d2d/dq2. */

typedef long long casadi_int;

static const casadi_int SCALAR[3] = {1, 1, 1}, SHAPE[3] = {JOINTS, 1, 1}, ROW[3] = {1, JOINTS, 1},
                        SQUARE[3] = {JOINTS, JOINTS, 1};

#define INTERFACE(NAME, INPUTS, RESULT)                                                         \
  casadi_int NAME##_n_in(void) { return INPUTS; }                                               \
  casadi_int NAME##_n_out(void) { return 1; }                                                   \
  const casadi_int *NAME##_sparsity_in(casadi_int i) { return i ? SCALAR : SHAPE; }             \
  const casadi_int *NAME##_sparsity_out(casadi_int i) { return i ? 0 : RESULT; }                \
  int NAME##_work(casadi_int *a, casadi_int *r, casadi_int *i, casadi_int *w) {                 \
    *a = INPUTS, *r = 1, *i = 0, *w = JOINTS;                                                   \
    return 0;                                                                                   \
  }                                                                                             \
  int NAME(const double **arg, double **res, casadi_int *iw, double *w, int mem)

INTERFACE(link_distance, 2, SCALAR) {
  (void)iw, (void)w, (void)mem;
  if (res[0]) res[0][0] = distance((int)arg[1][0], arg[0], 0, 0, 0);
  return 0;
}

INTERFACE(link_distance_jac, 2, ROW) {
  (void)iw, (void)w, (void)mem;
  if (res[0]) distance((int)arg[1][0], arg[0], 0, res[0], 0);
  return 0;
}

INTERFACE(link_distance_hess, 3, SQUARE) {
  (void)iw, (void)mem;
  if (res[0]) distance((int)arg[1][0], arg[0], arg[2][0], w, res[0]);
  return 0;
}
