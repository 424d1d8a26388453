/* Rotations, small dense factorizations, and functions of numbers.  Matrices are row-major. */

/* fmin and fmax without a function call; b must not be NaN. */
static double ip_least(double a, double b)
{
  return a < b ? a : b;
}

static double ip_most(double a, double b)
{
  return a > b ? a : b;
}

/* Write the component of the vector `heading` that is orthogonal to the unit vector n, and return its length. */
static double ip_across(const double *n, const double *heading, double *across)
{
  memcpy(across, heading, sizeof(double) * 3);
  ip_add(across, -ip_dot(n, heading, 3), n, 3);
  return sqrt(ip_dot(across, across, 3));
}

/* out = A'B for rotation matrices. */
static void ip_relative(const double *A, const double *B, double *out)
{
  int i, j;
  for (i = 0; i < 3; ++i) {
    for (j = 0; j < 3; ++j) {
      out[3 * i + j] = A[i] * B[j] + A[3 + i] * B[3 + j] + A[6 + i] * B[6 + j];
    }
  }
}

/* Compute the quaternion x y z w of a rotation, starting from its largest component. */
static void ip_quaternion(const double *R, double *x)
{
  const double trace = R[0] + R[4] + R[8];
  int i = R[4] > R[0] ? 1 : 0, j, k;
  double root;
  i = R[8] > R[4 * i] ? 2 : i;
  if (trace > 0.0) {
    root = sqrt(1.0 + trace);
    x[3] = 0.5 * root;
    x[0] = (R[7] - R[5]) * 0.5 / root;
    x[1] = (R[2] - R[6]) * 0.5 / root;
    x[2] = (R[3] - R[1]) * 0.5 / root;
    return;
  }
  j = (i + 1) % 3;
  k = (i + 2) % 3;
  root = sqrt(1.0 + R[4 * i] - R[4 * j] - R[4 * k]);
  x[i] = 0.5 * root;
  x[3] = (R[3 * k + j] - R[3 * j + k]) * 0.5 / root;
  x[j] = (R[3 * j + i] + R[3 * i + j]) * 0.5 / root;
  x[k] = (R[3 * k + i] + R[3 * i + k]) * 0.5 / root;
}

static void ip_log3(const double *R, double *w)
{
  double x[4];
  ip_quaternion(R, x);
  ip_log_quaternion(x, w);
}

/* Replace the upper triangle of the n x n matrix A by R with A = R'R.  Return 0 if A is not positive definite. */
static int ip_cholesky(double *A, int n)
{
  int i, k;
  for (i = 0; i < n; ++i) {
    double *row = A + i * n, s;
    /* The test is not "<=", because "<=" is false for NaN. */
    if (!(row[i] > 0.0)) {
      return 0;
    }
    s = 1.0 / sqrt(row[i]);
    ip_scaled(row + i, s, row + i, n - i);
    for (k = i + 1; k < n; ++k) {
      ip_add(A + k * (n + 1), -row[k], row + k, n - k);
    }
  }
  return 1;
}
