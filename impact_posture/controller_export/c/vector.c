/* Loops over vectors. */

/* Two doubles that are added and multiplied at once, where a compiler has them: it may not reorder a sum by itself. */
#if defined(__GNUC__)
typedef double ip_pair __attribute__((vector_size(16), aligned(8), may_alias));
#define IP_PAIR(p) (*(const ip_pair *)(p))
#define IP_PUT_PAIR(p, values) (*(ip_pair *)(p) = (values))
#endif

static double ip_dot(const double *a, const double *b, int n)
{
  double sum = 0.0;
  int i = 0;
#if defined(__GNUC__)
  /* Sums that do not wait for each other. */
  ip_pair s = {0.0, 0.0}, t = {0.0, 0.0};
  for (; i + 3 < n; i += 4) {
    s += IP_PAIR(a + i) * IP_PAIR(b + i);
    t += IP_PAIR(a + i + 2) * IP_PAIR(b + i + 2);
  }
  s += t;
  sum = s[0] + s[1];
#endif
  for (; i < n; ++i) {
    sum += a[i] * b[i];
  }
  return sum;
}

/* out = s x. */
static void ip_scaled(const double *x, double s, double *out, int n)
{
  int i = 0;
#if defined(__GNUC__)
  for (; i + 1 < n; i += 2) {
    IP_PUT_PAIR(out + i, s * IP_PAIR(x + i));
  }
#endif
  for (; i < n; ++i) {
    out[i] = s * x[i];
  }
}

/* As fmin and fmax where b is no NaN, and without a call. */
static double ip_least(double a, double b)
{
  return a < b ? a : b;
}

static double ip_most(double a, double b)
{
  return a > b ? a : b;
}

/* Part of a heading across the unit vector n; return its length. */
static double ip_across(const double *n, const double *heading, double *across)
{
  const double along = ip_dot(n, heading, 3);
  int i;
  for (i = 0; i < 3; ++i) {
    across[i] = heading[i] - n[i] * along;
  }
  return sqrt(ip_dot(across, across, 3));
}

