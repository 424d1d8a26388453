/* The QP of a tick in the form of DAQP: minimize |u|^2 subject to lower <= M u <= upper; each row has the length one.
 *
 * The variables are z = [v; w; f] (accelerations, spare thrusts, contact forces) and z = T (center + u), where T
 * makes the cost |T^-1 z|^2/2:
 * - IP_DENSE: T is the inverse of a Cholesky factor.  The bounds on joints are the last rows.
 * - IP_MOMENTUM: the cost is diagonal in the accelerations of the joints, the center of mass in the world (in place of the
 *   linear acceleration of the base), and the angular acceleration of the base.
 * - Otherwise T is diagonal.
 * Except with IP_DENSE, joints come first in u, and their bounds are bounds on u. */

/* Rows with a smaller length are treated as zero, as in DAQP. */
#define IP_NOTHING 1e-11
#define IP_JOINTS_V (IP_NV - IP_BASE)

/* Return the index in v (accelerations) of entry k of u. */
static int ip_entry(int k)
{
  return IP_DENSE ? k : k < IP_JOINTS_V ? k + IP_BASE : k - IP_JOINTS_V;
}

/* out = row T, where `row` multiplies the accelerations v. */
static void ip_whiten(const ip_context *c, const double *row, double *restrict out)
{
  int i, j;
#if IP_DENSE
  (void)i, (void)j;
  ip_combine(out, IP_NV, row, 1, c->factor, IP_NV, IP_NV);
#elif IP_MOMENTUM
  const double *M = c->m.M, *R = c->m.base, scale = 1.0 / M[0];
  const double x = row[0] * scale, y = row[1] * scale, z = row[2] * scale;
  i = 0;
#if defined(__GNUC__)
  for (; i + 1 < IP_JOINTS_V; i += 2) {
    j = IP_BASE + i;
    IP_PUT_PAIR(out + i, (IP_PAIR(row + j) - x * IP_PAIR(M + j) - y * IP_PAIR(M + IP_NV + j)
                          - z * IP_PAIR(M + 2 * IP_NV + j)) * IP_PAIR(c->ease + i));
  }
#endif
  for (; i < IP_JOINTS_V; ++i) {
    j = IP_BASE + i;
    out[i] = (row[j] - x * M[j] - y * M[IP_NV + j] - z * M[2 * IP_NV + j]) * c->ease[i];
  }
  for (j = 3; j < IP_BASE; ++j) {
    i = IP_JOINTS_V + j;
    out[i] = (row[j] - x * M[j] - y * M[IP_NV + j] - z * M[2 * IP_NV + j]) * c->ease[i];
  }
  for (i = 0; i < 3; ++i) {
    out[IP_JOINTS_V + i] = ip_dot(R + 3 * i, row, 3) * c->ease[IP_JOINTS_V + i];
  }
#else
  (void)j;
  for (i = 0; i < IP_NV; ++i) {
    out[i] = row[ip_entry(i)] * c->ease[i];
  }
#endif
}

/* Scale a row of M to the length one, and set its bounds. */
static void ip_finish(ip_context *c, int r, double lower, double upper)
{
  double *row = c->M[r], length = ip_dot(row, row, IP_VARIABLES), scale;
  const double shift = ip_dot(row, c->center, IP_NV);
  const int at = IP_SIMPLE + r;
  /* The sum shows later whether all numbers were finite. */
  c->sum += length + shift + (isnan(lower) || isnan(upper) ? NAN : 0.0);
  scale = length > IP_NOTHING * IP_NOTHING ? 1.0 / sqrt(length) : 1.0;
  ip_scaled(row, scale, row, IP_VARIABLES);
  c->scaling[at] = scale;
  c->high[at] = upper;
  c->low[at] = lower;
  c->upper[at] = (upper - shift) * scale;
  c->lower[at] = (lower - shift) * scale;
}

/* Add the cost of weighted tasks, soft contacts and the posture to H and g.  Only the upper triangle of H is written;
 * its rows have `stride` numbers.  The linear term of the cost is -g. */
static void ip_cost(const ip_context *c, double *H, int stride, double *g)
{
  int i, r;
  for (r = IP_STRICT; r < IP_ROWS + IP_FORCES; ++r) {
    const int f = r - IP_ROWS, k = f < 0 ? 0 : ip_force_contact[f];
    const double *J = f < 0 ? c->J[r] : ip_contact_motion(c, f), a = f < 0 ? c->a[r] : c->contact_a[f];
    const double weight = f < 0 ? c->p.task_weight[r] : ip_contact_hard[k] ? 0.0 : c->p.contact_weight[k];
    for (i = 0; i < IP_NV && weight > 0.0; ++i) {
      const double s = weight * J[i];
      g[i] += s * a;
      ip_add(H + i * stride + i, s, J + i, IP_NV - i);
    }
  }
  for (i = 0; i < IP_NV; ++i) {
    H[i * (stride + 1)] += c->added[i];
    g[i] += c->p.posture_weight[i] * c->wanted[i];
  }
}

/* Compute T and the minimum of the cost, `center`. */
static void ip_factorize(ip_context *c)
{
  double g[IP_NV] = {0};
  int i, j, k;
#if IP_DENSE
  double *inverse = c->factor, *R = c->scratch;
  memset(R, 0, sizeof c->factor);
  ip_cost(c, R, IP_NV, g);
  if (!ip_cholesky(R, IP_NV)) {
    c->sum = NAN;
  }
  /* Invert the triangular matrix, from the last row to the first. */
  for (i = IP_NV - 1; i >= 0; --i) {
    const double pivot = 1.0 / R[i * (IP_NV + 1)];
    double *out = inverse + i * IP_NV;
    for (j = i; j < IP_NV; ++j) {
      out[j] = i == j ? pivot : 0.0;
    }
    for (k = i + 1; k < IP_NV; ++k) {
      ip_add(out + k, -R[i * IP_NV + k] * pivot, inverse + k * (IP_NV + 1), IP_NV - k);
    }
  }
#else
  (void)j;
  for (i = 0; i < IP_NV; ++i) {
    g[i] = c->p.posture_weight[i] * c->wanted[i];
  }
  for (k = 0; IP_MOMENTUM && k < IP_TASKS; ++k) {
    for (i = ip_task_row[k]; i < ip_task_row[k + 1]; ++i) {
      g[(ip_task_kind[k] == IP_BASE_TURN ? 3 : 0) + i - ip_task_row[k]] += c->p.task_weight[i] * c->a[i];
    }
  }
#endif
#if IP_MOMENTUM
  for (i = 0; i < IP_NV; ++i) {
    c->center[i] = g[ip_entry(i)] * c->ease[i];
  }
#else
  ip_whiten(c, g, c->center);
#endif
}

/* Write the row of s'(M v + h - J'f), and return s'h.  s has `count` nonzero entries, from the entry `first` on. */
static double ip_force_row(const ip_context *c, const double *s, int first, int count, double *restrict row)
{
  double bias = s[0] * c->free_force[first];
  int i, j, k;
  ip_scaled(c->m.M + first * IP_NV, s[0], row, IP_NV);
  for (i = 1; i < count; ++i) {
    bias += s[i] * c->free_force[first + i];
    if (s[i] != 0.0) {
      ip_add(row, s[i], c->m.M + (first + i) * IP_NV, IP_NV);
    }
  }
  memset(row + IP_NV, 0, sizeof(double) * IP_SPARE);
  for (k = 0; k < IP_CONTACTS; ++k) {
    const double *J = c->m.jacobian[ip_contact_point[k]] + first;
    for (j = ip_contact_row[k]; j < ip_contact_row[k + 1]; ++j, J += IP_NV) {
      double sum = s[0] * J[0];
      for (i = 1; i < count; ++i) {
        sum += s[i] * J[i];
      }
      row[IP_NV + IP_SPARE + j] = -sum;
    }
  }
  return bias;
}

/* Transform a row on [v; w; f] into a row of M. */
static void ip_put(ip_context *c, int r, double lower, double upper)
{
  const double *row = c->rows[r];
  int j;
  ip_whiten(c, row, c->M[r]);
  for (j = IP_NV; j < IP_VARIABLES; ++j) {
    c->M[r][j] = row[j] * c->ease[j];
  }
  ip_finish(c, r, lower, upper);
}

/* Fill M and the bounds for this tick. */
static void ip_assemble(ip_context *c)
{
  double to[2], one = 1.0, bias;
  int i, j, r = 0;
  c->sum = 0.0;
  ip_factorize(c);
  for (i = 0; i < IP_BLIND; ++i) {
    double s[6] = {0};
    for (j = 0; j < IP_BASE; ++j) {
      s[j] = ip_blind[j * IP_BLIND + i];
    }
    bias = ip_force_row(c, s, 0, IP_BASE, c->rows[r]);
    ip_put(c, r++, -bias, -bias);
  }
  for (i = 0; i < IP_FORCES; ++i) {
    if (ip_contact_hard[ip_force_contact[i]]) {
      memcpy(c->rows[r], ip_contact_motion(c, i), sizeof(double) * IP_NV);
      ip_put(c, r++, c->contact_a[i], c->contact_a[i]);
    }
  }
  for (i = 0; i < IP_STRICT; ++i) {
    memcpy(c->rows[r], c->J[i], sizeof(double) * IP_NV);
    ip_put(c, r++, c->a[i], c->a[i]);
  }
  for (i = 0; i < IP_CONTROLS; ++i) {
    if (i < IP_ROTORS) {
      bias = ip_force_row(c, ip_inverse + i * IP_BASE, 0, IP_BASE, c->rows[r]);
      for (j = 0; j < IP_SPARE; ++j) {
        c->rows[r][IP_NV + j] = ip_spare[i * IP_SPARE + j];
      }
    } else {
      bias = ip_force_row(c, &one, IP_BASE + i - IP_ROTORS, 1, c->rows[r]);
    }
    c->known[i] = bias;
    ip_put(c, r++, c->p.control_lower[i] - bias, c->p.control_upper[i] - bias);
  }
  /* The rows of the friction cones change only at a reset. */
  r += IP_CONES;
  for (i = 0; IP_LAW && i < IP_JOINTS_V; ++i) {
    ip_bounds(c, IP_BASE + i, to);
    if (IP_DENSE) {
      memset(c->M[r], 0, sizeof c->M[r]);
      memcpy(c->M[r], c->factor + (IP_BASE + i) * IP_NV, sizeof(double) * IP_NV);
      ip_finish(c, r++, -to[1], to[0]);
    } else {
      c->sum += isnan(to[0]) || isnan(to[1]) ? NAN : 0.0;
      c->high[i] = to[0];
      c->low[i] = -to[1];
      c->scaling[i] = 1.0 / c->ease[i];
      c->upper[i] = to[0] * c->scaling[i] - c->center[i];
      c->lower[i] = -to[1] * c->scaling[i] - c->center[i];
    }
  }
}

/* Reset the active set, so that only equations are active. */
static void ip_cool(ip_context *c)
{
  int i;
  for (i = 0; i < IP_SIMPLE + IP_GENERAL; ++i) {
    c->sense[i] = i >= IP_SIMPLE && i < IP_SIMPLE + IP_EQUATIONS ? DAQP_ACTIVE + DAQP_IMMUTABLE : 0;
  }
}

/* Read the weights, and transform the rows of the friction cones to rows of M. */
static void ip_begin_qp(ip_context *c)
{
  int i, k;
  for (i = 0; i < IP_NV; ++i) {
    /* A small weight on every acceleration ensures that the cost has a minimum. */
    c->added[i] = fmax(c->p.posture_weight[i], 1e-8);
  }
  for (i = 0; i < IP_NV; ++i) {
    double weight = c->added[ip_entry(i)];
    for (k = 0; IP_MOMENTUM && k < IP_TASKS; ++k) {
      const int first = ip_task_kind[k] == IP_BASE_TURN ? 3 : 0, row = ip_entry(i) - first;
      weight = row >= 0 && row < 3 ? c->p.task_weight[ip_task_row[k] + row] + (first ? weight : 0.0) : weight;
    }
    c->ease[i] = 1.0 / sqrt(weight);
  }
  for (i = 0; i < IP_SPARE; ++i) {
    c->ease[IP_NV + i] = 1.0 / sqrt(c->p.spare_weight[0]);
  }
  for (i = 0; i < IP_FORCES; ++i) {
    const int row = i - ip_contact_row[ip_force_contact[i]];
    /* A moment of 1 N m has the same cost as a force of 10 N. */
    c->ease[IP_NV + IP_SPARE + i] = 1.0 / sqrt(c->p.force_weight[0] * (row < 3 ? 1.0 : 100.0));
  }
  memset(c->center, 0, sizeof c->center);
  for (k = 0; k < IP_CONTACTS; ++k) {
    for (i = ip_contact_cone[k]; i < ip_contact_cone[k + 1]; ++i) {
      const double least = i == ip_contact_cone[k] ? c->p.contact_least[k] : 0.0;
      ip_put(c, IP_EQUATIONS + IP_CONTROLS + i, least, INFINITY);
    }
  }
  ip_cool(c);
}
