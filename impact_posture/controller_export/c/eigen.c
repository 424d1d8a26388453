/* Eigenvalues of a symmetric matrix: Householder's tridiagonal form, then QR steps with Wilkinson's shift (Golub and
 * Van Loan, Matrix Computations, sections 8.3.1 and 8.3.3). */

/* Replace the symmetric n x n matrix A by the tridiagonal matrix V A V'.  Only the diagonal and the entries above the
 * diagonal are written. */
static void ip_tridiagonal(double *A, double *V, int n)
{
  double p[IP_LARGEST], beta[IP_LARGEST], e[IP_LARGEST];
  int i, k;
  for (k = 0; k + 1 < n; ++k) {
    /* Compute the reflection I - beta v v', which acts on the entries from k + 1 on. */
    double *v = A + k * n, size = sqrt(ip_dot(v + k + 1, v + k + 1, n - k - 1)), half = 0.0;
    beta[k] = 0.0;
    e[k] = v[k + 1];
    if (k + 2 == n || !(size > 0.0)) {
      continue;
    }
    e[k] = v[k + 1] < 0.0 ? size : -size;
    v[k + 1] -= e[k];
    beta[k] = 1.0 / (size * fabs(v[k + 1]));
    for (i = k + 1; i < n; ++i) {
      p[i] = beta[k] * ip_dot(A + i * n + k + 1, v + k + 1, n - k - 1);
      half += 0.5 * beta[k] * p[i] * v[i];
    }
    ip_add(p + k + 1, -half, v + k + 1, n - k - 1);
    for (i = k + 1; i < n; ++i) {
      ip_add(A + i * n + k + 1, -v[i], p + k + 1, n - k - 1);
      ip_add(A + i * n + k + 1, -p[i], v + k + 1, n - k - 1);
    }
  }
  for (i = 0; i < n * n; ++i) {
    V[i] = i % (n + 1) == 0 ? 1.0 : 0.0;
  }
  for (k = n - 2; k >= 0; --k) {
    const double *v = A + k * n + k + 1;
    for (i = k + 1; i < n; ++i) {
      double *row = V + i * n + k + 1;
      ip_add(row, -beta[k] * ip_dot(row, v, n - k - 1), v, n - k - 1);
    }
    A[k * n + k + 1] = e[k];
  }
}

/* Do one QR step on the rows low to high of the tridiagonal matrix with diagonal d and off-diagonal e. */
static void ip_qr_step(double *d, double *e, double *V, int n, int low, int high)
{
  const double half = 0.5 * (d[high - 1] - d[high]), t = e[high - 1];
  const double root = sqrt(half * half + t * t), shift = d[high] - t * t / (half + (half < 0.0 ? -root : root));
  double x = d[low] - shift, z = e[low];
  int k;
  for (k = low; k < high; ++k) {
    const double r = sqrt(x * x + z * z), c = r > 0.0 ? x / r : 1.0, s = r > 0.0 ? z / r : 0.0;
    const double a = d[k], b = e[k], g = d[k + 1];
    if (k > low) {
      e[k - 1] = r;
    }
    d[k] = c * c * a + 2.0 * c * s * b + s * s * g;
    d[k + 1] = s * s * a - 2.0 * c * s * b + c * c * g;
    e[k] = c * s * (g - a) + (c * c - s * s) * b;
    x = e[k];
    if (k < high - 1) {
      z = s * e[k + 1];
      e[k + 1] *= c;
    }
    ip_rotate(V + k * n, V + (k + 1) * n, c, s, n);
  }
}

/* Diagonalize a tridiagonal matrix by at most about `rotations` rotations. */
static void ip_diagonalize(double *A, double *V, int n, int rotations)
{
  double e[IP_LARGEST], d[IP_LARGEST];
  int k, high, low;
  for (k = 0; k < n; ++k) {
    d[k] = A[k * (n + 1)];
    e[k] = k + 1 < n ? A[k * n + k + 1] : 0.0;
  }
  for (high = n - 1; high > 0 && rotations > 0;) {
    low = high;
    while (low > 0 && fabs(e[low - 1]) > 1e-16 * (fabs(d[low - 1]) + fabs(d[low]))) {
      --low;
    }
    if (low == high) {
      --high;
    } else {
      ip_qr_step(d, e, V, n, low, high);
      rotations -= high - low;
    }
  }
  for (k = 0; k < n; ++k) {
    A[k * (n + 1)] = d[k];
    if (k + 1 < n) {
      A[k * n + k + 1] = e[k];
    }
  }
}

/* Write the eigenvalues of the symmetric n x n matrix A on its diagonal, and the eigenvectors in the rows of V.
 * Return the largest eigenvalue, or 0 if all are negative. */
static double ip_eigen(double *A, double *V, int n)
{
  double most = 0.0;
  int k;
  ip_tridiagonal(A, V, n);
  ip_diagonalize(A, V, n, 30 * n * n);
  for (k = 0; k < n; ++k) {
    most = fmax(most, A[k * (n + 1)]);
  }
  return most;
}
