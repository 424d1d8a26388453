/* Solve the QP by DAQP, starting from the last active set. */

/* out += T x. */
static void ip_add_turned(const ip_context *c, const double *x, double *out)
{
  int i, j;
  (void)j;
#if IP_MOMENTUM
  double moved[3] = {0};
#endif
  for (i = 0; i < IP_NV; ++i) {
#if IP_DENSE
    out[i] += ip_dot(c->factor + i * (IP_NV + 1), x + i, IP_NV - i);
#elif IP_MOMENTUM
    const double step = c->ease[i] * x[i];
    const int at = ip_entry(i);
    out[at] += at < 3 ? 0.0 : step;
    for (j = 0; j < 3; ++j) {
      moved[j] += at < 3 ? c->m.base[3 * at + j] * step : -c->m.M[j * IP_NV + at] / c->m.M[0] * step;
    }
#else
    out[ip_entry(i)] += c->ease[i] * x[i];
#endif
  }
#if IP_MOMENTUM
  for (j = 0; j < 3; ++j) {
    out[j] += moved[j];
  }
#endif
  for (i = IP_NV; i < IP_VARIABLES; ++i) {
    out[i] += c->ease[i] * x[i];
  }
}

/* Compute z = [v; w; f] from u.  Then correct z, so that the active rows hold to the last digit, because large
 * weights of the cost make the variables of DAQP less exact. */
static void ip_decode(ip_context *c, DAQPWorkspace *w)
{
  double x[IP_VARIABLES];
  int i;
  for (i = 0; i < IP_VARIABLES; ++i) {
    x[i] = c->center[i] + c->u[i];
    c->z[i] = 0.0;
  }
  ip_add_turned(c, x, c->z);
  memset(x, 0, sizeof x);
#if IP_MOMENTUM
  /* The diagonal cost does not contain the small weight that every acceleration of the base has. */
  double rest[IP_NV] = {0};
  for (i = 0; i < 3; ++i) {
    rest[i] = -c->added[i] * c->z[i];
  }
  ip_whiten(c, rest, x);
#endif
  for (i = 0; i < w->n_active; ++i) {
    const int at = w->WS[i], r = at - IP_SIMPLE, joint = IP_DENSE ? r - (IP_GENERAL - IP_JOINTS_V) : at;
    const int bounds = IP_LAW && (IP_DENSE ? joint >= 0 : r < 0);
    const double value = bounds ? c->z[IP_BASE + joint] : ip_dot(c->rows[r], c->z, IP_VARIABLES);
    w->xldl[i] = c->scaling[at] * (value - (c->sense[at] & DAQP_LOWER ? c->low[at] : c->high[at]));
    if (IP_MOMENTUM) {
      w->xldl[i] += at < IP_SIMPLE ? x[at] : ip_dot(c->M[at - IP_SIMPLE], x, IP_VARIABLES);
    }
  }
  daqp_solve_working_set(w);
  for (i = 0; i < w->n_active; ++i) {
    const int at = w->WS[i];
    w->lam_star[i] += w->xldl[i];
    if (IP_SIMPLE && at < IP_SIMPLE) {
      x[at] -= w->xldl[i];
    } else {
      ip_add(x, -w->xldl[i], c->M[at - IP_SIMPLE], IP_VARIABLES);
    }
  }
  ip_add_turned(c, x, c->z);
}

/* Memory of DAQP on the stack, large enough for the QP of a tick and the QP of the flow. */
typedef struct {
  double lam[IP_VARIABLES + 1], lam_star[IP_VARIABLES + 1], xldl[IP_VARIABLES + 1], zldl[IP_VARIABLES + 1];
  double D[IP_VARIABLES + 1], L[(IP_VARIABLES + 1) * (IP_VARIABLES + 2) / 2], xold[IP_VARIABLES];
  double Mu[IP_GENERAL > IP_FLOW_ROWS ? IP_GENERAL : IP_FLOW_ROWS];
  int WS[IP_VARIABLES + 1], prox[IP_VARIABLES];
  DAQPSettings settings;
} ip_memory;

/* Prepare a program with n variables, `simple` bounds on variables and m - `simple` rows.  The caller sets the
 * numbers of bounds and rows. */
static void ip_prepare(ip_memory *s, int n, int simple, int m, double *u, DAQPWorkspace *w)
{
  memset(s->prox, 0, sizeof s->prox);
  s->settings = (DAQPSettings){
    .primal_tol = 1e-9, .dual_tol = DAQP_DEFAULT_DUAL_TOL, .zero_tol = DAQP_DEFAULT_ZERO_TOL,
    .pivot_tol = DAQP_DEFAULT_PIVOT_TOL, .progress_tol = DAQP_DEFAULT_PROG_TOL, .cycle_tol = DAQP_DEFAULT_CYCLE_TOL,
    .iter_limit = IP_ITERATIONS, .fval_bound = DAQP_INF, .rho_soft = DAQP_DEFAULT_RHO_SOFT,
    .sing_tol = 1e-13 /* as in Python */, .refactor_tol = DAQP_DEFAULT_REFACTOR_TOL, .eq_reduction = DAQP_EQ_REDUCTION_OFF
  };
  *w = (DAQPWorkspace){
    .settings = &s->settings, .n = n, .m = m, .ms = simple, .Mu = s->Mu, .lam = s->lam, .lam_star = s->lam_star,
    .WS = s->WS, .D = s->D, .L = s->L, .xldl = s->xldl, .zldl = s->zldl, .u = u, .x = u, .xold = s->xold,
    .prox_mask = s->prox, .outer_iter = 1
  };
  memset(u, 0, sizeof(double) * (size_t)n);
}

/* Solve from the present active set.  Return the flag of DAQP, positive for a solution. */
static int ip_solve_warm(ip_context *c)
{
  enum { M = IP_SIMPLE + IP_GENERAL };
  ip_memory memory;
  DAQPWorkspace w;
  int i, flag;
  for (i = 0; i < M; ++i) {
    if (c->upper[i] - c->lower[i] < -1e-9 * c->scaling[i]) {
      return DAQP_EXIT_INFEASIBLE;
    }
  }
  ip_prepare(&memory, IP_VARIABLES, IP_SIMPLE, M, c->u, &w);
  w.M = c->M[0];
  w.dupper = c->upper;
  w.dlower = c->lower;
  w.scaling = c->scaling;
  w.sense = c->sense;
  flag = daqp_reactivate_constraints(&w);
  flag = flag < 0 ? flag : daqp_ldp(&w);
  c->iterations += w.iterations;
  if (w.state & DAQP_STATE_NOISE_FLOOR) {
    /* DAQP cycled, and its answer violates bounds. */
    flag = DAQP_EXIT_CYCLE;
  }
  memset(c->multipliers, 0, sizeof c->multipliers);
  if (flag > 0) {
    ip_decode(c, &w);
  }
  for (i = 0; flag > 0 && i < w.n_active; ++i) {
    c->multipliers[w.WS[i]] = w.lam_star[i] * c->scaling[w.WS[i]];
  }
  if (flag <= 0) {
    ip_cool(c);
  }
  return flag;
}

