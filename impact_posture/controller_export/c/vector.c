/* Loops over vectors. */

/* Two doubles that one instruction adds or multiplies.  Explicit vectors are necessary, because a compiler may not
 * change the order of a sum. */
#if defined(__GNUC__)
typedef double ip_pair __attribute__((vector_size(16), aligned(8), may_alias));
#define IP_PAIR(p) (*(const ip_pair *)(p))
#define IP_PUT_PAIR(p, values) (*(ip_pair *)(p) = (values))
#endif

static inline double ip_dot(const double *a, const double *b, int n)
{
  double sum = 0.0;
  int i = 0;
#if defined(__GNUC__)
  /* Use several independent sums, because additions to one sum must wait for each other. */
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

/* out = a - b. */
static inline void ip_subtract(const double *a, const double *b, double *out, int n)
{
  int i;
  for (i = 0; i < n; ++i) {
    out[i] = a[i] - b[i];
  }
}

/* Replace x by c x + s y and y by c y - s x. */
static inline void ip_rotate(double *restrict x, double *restrict y, double c, double s, int n)
{
  int i = 0;
#if defined(__GNUC__)
  for (; i + 1 < n; i += 2) {
    const ip_pair a = IP_PAIR(x + i), b = IP_PAIR(y + i);
    IP_PUT_PAIR(x + i, c * a + s * b);
    IP_PUT_PAIR(y + i, c * b - s * a);
  }
#endif
  for (; i < n; ++i) {
    const double a = x[i], b = y[i];
    x[i] = c * a + s * b;
    y[i] = c * b - s * a;
  }
}

/* out += s x. */
static inline void ip_add(double *restrict out, double s, const double *restrict x, int n)
{
  int i = 0;
#if defined(__GNUC__)
  for (; i + 1 < n; i += 2) {
    IP_PUT_PAIR(out + i, IP_PAIR(out + i) + s * IP_PAIR(x + i));
  }
#endif
  for (; i < n; ++i) {
    out[i] += s * x[i];
  }
}

/* out = sum over k of a[k step] times the n numbers from x[k stride] on. */
static inline void ip_combine(double *restrict out, int n, const double *a, int step, const double *x, int stride, int count)
{
  int i = 0, k;
#if defined(__GNUC__)
  /* Compute eight or four sums at a time, which stay in registers. */
  for (; i + 7 < n; i += 8) {
    ip_pair s0 = {0.0, 0.0}, s1 = {0.0, 0.0}, s2 = {0.0, 0.0}, s3 = {0.0, 0.0};
    const double *c = a, *y = x + i;
    for (k = 0; k < count; ++k, c += step, y += stride) {
      if (*c != 0.0) {
        s0 += *c * IP_PAIR(y);
        s1 += *c * IP_PAIR(y + 2);
        s2 += *c * IP_PAIR(y + 4);
        s3 += *c * IP_PAIR(y + 6);
      }
    }
    IP_PUT_PAIR(out + i, s0);
    IP_PUT_PAIR(out + i + 2, s1);
    IP_PUT_PAIR(out + i + 4, s2);
    IP_PUT_PAIR(out + i + 6, s3);
  }
  for (; i + 3 < n; i += 4) {
    ip_pair s0 = {0.0, 0.0}, s1 = {0.0, 0.0};
    const double *c = a, *y = x + i;
    for (k = 0; k < count; ++k, c += step, y += stride) {
      s0 += *c * IP_PAIR(y);
      s1 += *c * IP_PAIR(y + 2);
    }
    IP_PUT_PAIR(out + i, s0);
    IP_PUT_PAIR(out + i + 2, s1);
  }
#endif
  for (; i < n; ++i) {
    double sum = 0.0;
    for (k = 0; k < count; ++k) {
      sum += a[k * step] * x[k * stride + i];
    }
    out[i] = sum;
  }
}
