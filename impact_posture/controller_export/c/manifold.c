/* The configuration manifold: differences and sums of configurations.  Matrices are row-major. */

/* Families of joints, the values of ip_joint_family. */
enum { IP_DIRECT, IP_CONTINUOUS, IP_FREE_FLYER, IP_SPHERICAL };

static void ip_cross(const double *a, const double *b, double *out)
{
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

/* out = R x, or R'x. */
static void ip_turn(const double *R, const double *x, int transposed, double *out)
{
  int i;
  for (i = 0; i < 3; ++i) {
    out[i] = transposed ? R[i] * x[0] + R[3 + i] * x[1] + R[6 + i] * x[2] : ip_dot(R + 3 * i, x, 3);
  }
}

/* Compute angle times axis of a unit quaternion. */
static void ip_log_quaternion(const double *x, double *w)
{
  const double sine = sqrt(ip_dot(x, x, 3)), sign = x[3] < 0.0 ? -1.0 : 1.0;
  const double scale = sine < 1e-8 ? 2.0 : 2.0 * atan2(sine, sign * x[3]) / sine;
  ip_scaled(x, sign * scale, w, 3);
}

/* Compute the linear part of log6 for the rotation vector w and the translation p. */
static void ip_log6_linear(const double *w, const double *p, double *out)
{
  const double t2 = ip_dot(w, w, 3), t = sqrt(t2);
  const double b = t < 1e-2 ? 1.0 / 12.0 + t2 * (1.0 / 720.0 + t2 / 30240.0)
                            : 1.0 / t2 - cos(0.5 * t) / (2.0 * t * sin(0.5 * t));
  double once[3], twice[3];
  int i;
  ip_cross(w, p, once);
  ip_cross(w, once, twice);
  for (i = 0; i < 3; ++i) {
    out[i] = p[i] - 0.5 * once[i] + b * twice[i];
  }
}

static void ip_matrix(const double *x, double *R)
{
  R[0] = 1.0 - 2.0 * (x[1] * x[1] + x[2] * x[2]);
  R[1] = 2.0 * (x[0] * x[1] - x[2] * x[3]);
  R[2] = 2.0 * (x[0] * x[2] + x[1] * x[3]);
  R[3] = 2.0 * (x[0] * x[1] + x[2] * x[3]);
  R[4] = 1.0 - 2.0 * (x[0] * x[0] + x[2] * x[2]);
  R[5] = 2.0 * (x[1] * x[2] - x[0] * x[3]);
  R[6] = 2.0 * (x[0] * x[2] - x[1] * x[3]);
  R[7] = 2.0 * (x[1] * x[2] + x[0] * x[3]);
  R[8] = 1.0 - 2.0 * (x[0] * x[0] + x[1] * x[1]);
}

/* out = conj(a) b, or a b. */
static void ip_product(const double *a, const double *b, int conjugate, double *out)
{
  const double s = conjugate ? -1.0 : 1.0;
  double product[4];
  product[0] = a[3] * b[0] + s * (b[3] * a[0] + a[1] * b[2] - a[2] * b[1]);
  product[1] = a[3] * b[1] + s * (b[3] * a[1] + a[2] * b[0] - a[0] * b[2]);
  product[2] = a[3] * b[2] + s * (b[3] * a[2] + a[0] * b[1] - a[1] * b[0]);
  product[3] = a[3] * b[3] - s * ip_dot(a, b, 3);
  memcpy(out, product, sizeof product);
}

/* v = b - a on the manifold, in the tangent space at a (NV numbers). */
static void ip_difference(const double *a, const double *b, double *v)
{
  double x[4], R[9], moved[3], p[3];
  int k;
  for (k = 0; k < IP_JOINTS; ++k) {
    const double *from = a + ip_joint_q[k], *to = b + ip_joint_q[k];
    double *out = v + ip_joint_v[k];
    if (ip_joint_family[k] == IP_FREE_FLYER) {
      ip_product(from + 3, to + 3, 1, x);
      ip_log_quaternion(x, out + 3);
      ip_matrix(from + 3, R);
      ip_subtract(to, from, moved, 3);
      ip_turn(R, moved, 1, p);
      ip_log6_linear(out + 3, p, out);
    } else if (ip_joint_family[k] == IP_SPHERICAL) {
      ip_product(from, to, 1, x);
      ip_log_quaternion(x, out);
    } else if (ip_joint_family[k] == IP_CONTINUOUS) {
      out[0] = atan2(from[0] * to[1] - from[1] * to[0], from[0] * to[0] + from[1] * to[1]);
    } else {
      out[0] = to[0] - from[0];
    }
  }
}

/* Compute the unit quaternion of the rotation vector w. */
static void ip_exponential(const double *w, double *x)
{
  const double t2 = ip_dot(w, w, 3), t = sqrt(t2);
  ip_scaled(w, t < 1e-4 ? 0.5 - t2 / 48.0 : sin(0.5 * t) / t, x, 3);
  x[3] = cos(0.5 * t);
}

/* out = q + step v on the manifold. */
static void ip_integrate(const double *q, const double *v, double step, double *out)
{
  double R[9], x[4], w[3], p[3], once[3], twice[3], far[3];
  int k, i;
  for (k = 0; k < IP_JOINTS; ++k) {
    const double *from = q + ip_joint_q[k], *rate = v + ip_joint_v[k];
    double *to = out + ip_joint_q[k];
    const int turns = ip_joint_family[k] == IP_FREE_FLYER ? 3 : 0;
    if (ip_joint_family[k] == IP_FREE_FLYER || ip_joint_family[k] == IP_SPHERICAL) {
      ip_scaled(rate + turns, step, w, 3);
      if (turns) {
        const double t2 = ip_dot(w, w, 3), t = sqrt(t2);
        const double b = t < 1e-2 ? 0.5 - t2 * (1.0 / 24.0 - t2 / 720.0) : (1.0 - cos(t)) / t2;
        const double c = t < 1e-2 ? 1.0 / 6.0 - t2 * (1.0 / 120.0 - t2 / 5040.0) : (t - sin(t)) / (t2 * t);
        ip_scaled(rate, step, p, 3);
        ip_cross(w, p, once);
        ip_cross(w, once, twice);
        for (i = 0; i < 3; ++i) {
          p[i] += b * once[i] + c * twice[i];
        }
        ip_matrix(from + 3, R);
        ip_turn(R, p, 0, far);
        for (i = 0; i < 3; ++i) {
          to[i] = from[i] + far[i];
        }
      }
      ip_exponential(w, x);
      ip_product(from + turns, x, 0, to + turns);
    } else if (ip_joint_family[k] == IP_CONTINUOUS) {
      const double c = cos(step * rate[0]), s = sin(step * rate[0]), was = from[0];
      to[0] = c * was - s * from[1];
      to[1] = s * was + c * from[1];
    } else {
      to[0] = from[0] + step * rate[0];
    }
  }
}
