/* Relaxed solution of a tick in which the strict priority levels are infeasible (relaxation.h). */

/* Number of rows of the QP, without the rows that bound joint accelerations. */
#define IP_OTHERS (IP_GENERAL - (IP_DENSE ? IP_BOUNDED : 0))
/* Unit of contact forces, divided by the mass of the robot times 1 m/s2.  Of the values from 0.03 to 10, this value
 * led to the fewest iterations for pushed robots. */
#define IP_FORCE_UNIT 0.1

/* Write the largest violation of an acceleration bound, then the error norm of each level, to c->gave. */
static void ip_list_gave_way(ip_context *c, const double *lower, const double *upper)
{
  double most = 0.0, size = 1.0;
  int i, j, k, r = IP_BLIND;
  memset(c->gave, 0, sizeof c->gave);
  for (i = IP_BASE; IP_LAW && i < IP_NV; ++i) {
    most = fmax(most, fmax(lower[i] - c->z[i], c->z[i] - upper[i]));
    size = fmax(size, 1.0 + fabs(c->z[i]));
  }
  c->gave[0] = most > IP_OFF * size ? most : 0.0;
  for (k = 0; k < IP_LEVELS; ++k) {
    /* Sums over the equations of the level (index 0) and over its dependent rows (index 1). */
    double square[2] = {0}, worst[2] = {0}, sizes[2] = {1.0, 1.0};
    for (i = r; i < r + ip_level_rows[k]; ++i) {
      const int lacks = isinf(c->low[IP_SIMPLE + i]) ? 1 : 0;
      const double off = ip_dot(c->rows[i], c->z, IP_VARIABLES) - (lacks ? c->wanted_rows[i] : c->low[IP_SIMPLE + i]);
      double terms = 1.0;
      for (j = 0; j < IP_VARIABLES; ++j) {
        terms += fabs(c->rows[i][j] * c->z[j]);
      }
      square[lacks] += off * off;
      worst[lacks] = fmax(worst[lacks], fabs(off));
      sizes[lacks] = fmax(sizes[lacks], terms);
    }
    c->gave[1 + k] = worst[0] > IP_OFF * sizes[0] ? sqrt(square[0]) : 0.0;
    c->missed[k] = worst[1] > IP_OFF * sizes[1] ? sqrt(square[1]) : 0.0;
    r += ip_level_rows[k];
  }
}

/* Compute the relaxed answer z.  Return whether the relaxation gave an answer. */
static int ip_relax(ip_context *c)
{
  enum { N = IP_VARIABLES, M = IP_OTHERS };
  double g[N] = {0}, unit[N], lower[N + M], upper[N + M], *H = c->scratch;
  int level[N + M] = {0}, i, j, k, r, flag;
  const relaxation_problem problem = {
    .n = N, .m = M, .levels = 1 + IP_LEVELS, .A = c->rows[0], .lower = lower, .upper = upper, .level = level, .H = H,
    .g = g, .unit = unit
  };
  relaxation_report report;
  memset(H, 0, sizeof(double) * N * N);
  ip_cost(c, H, N, g);
  for (i = IP_NV; i < N; ++i) {
    H[i * (N + 1)] = 1.0 / (c->ease[i] * c->ease[i]);
  }
#if IP_LEVELS
  if (!c->independent) {
    for (i = 0; i < IP_NV; ++i) {
      memcpy(c->cost + i * IP_NV, H + i * N, sizeof(double) * IP_NV);
    }
    ip_reduce(c, H, g);
  }
#endif
  for (i = 0; i < N; ++i) {
    unit[i] = i < IP_NV + IP_SPARE ? 1.0 : IP_FORCE_UNIT * c->m.M[0];
    lower[i] = -INFINITY;
    upper[i] = INFINITY;
    g[i] = -g[i];
    for (j = 0; j < i; ++j) {
      H[i * N + j] = H[j * N + i];
    }
  }
  for (i = 0; IP_LAW && i < IP_JOINTS_V; ++i) {
    const int at = IP_DENSE ? IP_SIMPLE + M + i : i;
    level[IP_BASE + i] = 1;
    lower[IP_BASE + i] = c->low[at];
    upper[IP_BASE + i] = c->high[at];
  }
  memcpy(lower + N, c->low + IP_SIMPLE, sizeof(double) * M);
  memcpy(upper + N, c->high + IP_SIMPLE, sizeof(double) * M);
  for (k = 0, r = IP_BLIND; k < IP_LEVELS; r += ip_level_rows[k++]) {
    for (i = r; i < r + ip_level_rows[k]; ++i) {
      level[N + i] = 2 + k;
    }
  }
  flag = relaxation_solve(&problem, c->relaxation, IP_ITERATIONS, c->z, &report);
  c->iterations += report.iterations;
  memset(c->multipliers, 0, sizeof c->multipliers);
  if (flag > 0) {
    ip_list_gave_way(c, lower, upper);
  }
  return flag > 0;
}
