/* Eigenvalues of a symmetric matrix: Householder's tridiagonal form, then QR steps with Wilkinson's shift (Golub and Van
 * Loan, Matrix Computations, sections 8.3.1 and 8.3.3). */

/* Take the reflection I - beta v v' of the entries from k + 1 on out of A, and put it into the rows of V. */
static void ip_reflect(double *A, double *V, int n, int k, const double *v, double beta)
{
  double p[IP_LARGEST], half = 0.0;
  int i, j;
  for (i = k + 1; i < n; ++i) {
    p[i] = beta * ip_dot(A + i * n + k + 1, v + k + 1, n - k - 1);
    half += 0.5 * beta * p[i] * v[i];
  }
  ip_add(p + k + 1, -half, v + k + 1, n - k - 1);
  for (i = k + 1; i < n; ++i) {
    for (j = k + 1; j < n; ++j) {
      A[i * n + j] -= v[i] * p[j] + p[i] * v[j];
    }
  }
  memset(p, 0, sizeof p);
  for (i = k + 1; i < n; ++i) {
    ip_add(p, beta * v[i], V + i * n, n);
  }
  for (i = k + 1; i < n; ++i) {
    ip_add(V + i * n, -v[i], p, n);
  }
}

/* One QR step on the rows from low to high of the tridiagonal matrix with diagonal d and neighbors e. */
static void ip_qr_step(double *d, double *e, double *V, int n, int low, int high)
{
  const double half = 0.5 * (d[high - 1] - d[high]), t = e[high - 1];
  const double root = sqrt(half * half + t * t), shift = d[high] - t * t / (half + (half < 0.0 ? -root : root));
  double x = d[low] - shift, z = e[low];
  int k;
  for (k = low; k < high; ++k) {
    const double r = hypot(x, z), c = r > 0.0 ? x / r : 1.0, s = r > 0.0 ? z / r : 0.0;
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

/* Eigenvalues of the symmetric n x n matrix A on its diagonal, and eigenvectors in the rows of V.  Return the largest
 * eigenvalue, or 0 if all are negative. */
static double ip_eigen(double *A, double *V, int n)
{
  double v[IP_LARGEST], e[IP_LARGEST], d[IP_LARGEST], most = 0.0;
  int i, k, high, step;
  for (i = 0; i < n * n; ++i) {
    V[i] = i % (n + 1) == 0 ? 1.0 : 0.0;
  }
  for (k = 0; k + 1 < n; ++k) {
    double size = 0.0;
    for (i = k + 1; i < n; ++i) {
      v[i] = A[i * n + k];
      size += v[i] * v[i];
    }
    size = sqrt(size);
    e[k] = v[k + 1] < 0.0 ? size : -size;
    v[k + 1] -= e[k];
    if (k + 2 < n && size > 0.0) {
      ip_reflect(A, V, n, k, v, 1.0 / (size * fabs(v[k + 1])));
    } else {
      e[k] = A[(k + 1) * n + k];
    }
  }
  for (i = 0; i < n; ++i) {
    d[i] = A[i * (n + 1)];
  }
  for (high = n - 1, step = 0; high > 0 && step < 30 * n; ++step) {
    int low = high;
    while (low > 0 && fabs(e[low - 1]) > 1e-16 * (fabs(d[low - 1]) + fabs(d[low]))) {
      --low;
    }
    if (low == high) {
      --high;
    } else {
      ip_qr_step(d, e, V, n, low, high);
    }
  }
  for (i = 0; i < n; ++i) {
    A[i * (n + 1)] = d[i];
    most = fmax(most, d[i]);
  }
  return most;
}
