/* Direction of the reference flow: a saddle-free Newton step on the constraints, solved as a QP with limits.  The
 * formulas are in impact_posture/tsid/flow/flow_direction.py. */

/* Write the limits on a step along f->axes (NV x left) as rows into f->work, with their bounds. */
static void ip_flow_rows(ip_flow *f)
{
  enum { N = IP_NV };
  const double *axes = f->axes;
  const int n = f->left;
  int r;
  for (r = 0; r < IP_FLOW_ROWS; ++r) {
    const int k = r - IP_JOINTS_V;
    double *row = f->work + r * n, length, shift;
    if (k < 0) {
      memcpy(row, axes + (IP_BASE + r) * n, sizeof(double) * (size_t)n);
    } else {
      ip_combine(row, n, k < IP_PLACED ? f->row[k] : f->T[k - IP_PLACED], 1, axes, n, N);
    }
    length = ip_dot(row, row, n);
    shift = ip_dot(row, f->steep, n);
    f->scaling[r] = length >= IP_NOTHING ? 1.0 / sqrt(length) : 1.0;
    ip_scaled(row, f->scaling[r], row, n);
    f->upper[r] = (f->high[r] + shift) * f->scaling[r];
    f->lower[r] = (f->low[r] + shift) * f->scaling[r];
    /* A row of zeros does not limit the step. */
    f->sense[r] = length >= IP_NOTHING ? 0 : DAQP_IMMUTABLE;
  }
}

/* Set f->wanted = f->axes y, where y minimizes |y|^2/2 + f->steep y within the limits; set it to zero if the solver
 * fails.  With u = y + f->steep, the program minimizes |u|^2. */
APART static void ip_flow_solve(ip_flow *f)
{
  enum { N = IP_NV, M = IP_FLOW_ROWS };
  const double *slope = f->steep;
  double u[N], *step = f->wanted;
  const int n = f->left;
  int k;
  ip_memory memory;
  DAQPWorkspace w;
  f->gain = 0.0;
  if (n == 0) {
    return;
  }
  ip_prepare(&memory, n, 0, M, u, &w);
  w.M = f->work;
  w.dupper = f->upper;
  w.dlower = f->lower;
  w.scaling = f->scaling;
  w.sense = f->sense;
  if (daqp_reactivate_constraints(&w) < 0 || daqp_ldp(&w) <= 0 || w.state & DAQP_STATE_NOISE_FLOOR) {
    /* This flag means that the solver cycled and its answer violates bounds. */
    ++f->failures;
    return;
  }
  for (k = 0; k < n; ++k) {
    u[k] -= slope[k];
    f->gain -= slope[k] * u[k] + u[k] * u[k] / 2.0;
  }
  for (k = 0; k < N; ++k) {
    step[k] = ip_dot(f->axes + k * n, u, n);
  }
  if (!isfinite(ip_dot(step, step, N))) {
    ++f->failures;
    f->gain = 0.0;
    memset(step, 0, sizeof(double) * IP_NV);
  }
}

/* Return the square root of H/H0, which is at least IP_LEAST_VALUE. */
static double ip_flow_root(const ip_flow *f)
{
  return sqrt(fmax(fabs(f->value / f->start), IP_LEAST_VALUE));
}

/* Write curvature (f->work) and slope (f->steep) of 2 sqrt(H/H0) + rho/2 |q - q0|^2 along the redundancy. */
static void ip_flow_bend(ip_context *c)
{
  enum { N = IP_NV };
  ip_flow *f = &c->flow;
  double *C = f->work, offset[N], full[N];
  const double root = ip_flow_root(f), rho = c->p.flow_rho[0];
  const int n = f->left;
  int i, j, k;
  ip_difference(f->first, f->here, offset);
  for (i = 0; i < N; ++i) {
    full[i] = f->slope[i] / root + (i < IP_BASE ? 0.0 : rho * offset[i]);
  }
  for (k = 0; k < n; ++k) {
    f->steep[k] = ip_dot(f->Z[k], full, N);
    ip_combine(offset, N, f->Z[k], 1, f->B, N, N);
    ip_scaled(offset, 1.0 / root, offset, N);
    ip_add(offset + IP_BASE, rho, f->Z[k] + IP_BASE, N - IP_BASE);
    for (j = 0; j <= k; ++j) {
      C[k * n + j] = C[j * n + k] = ip_dot(f->Z[j], offset, N);
    }
  }
  for (i = 0; f->soft && i < IP_HELD; ++i) {
    /* Nearly dependent constraints are replaced by springs. */
    for (k = 0; k < n; ++k) {
      f->steep[k] -= IP_SPRING * f->spring[i][k] * f->error[i];
      ip_add(C + k * n, IP_SPRING * f->spring[i][k], f->spring[i], n);
    }
  }
}

/* Compute the axes of the Newton step (f->axes) from the eigenvectors of the curvature, and the slope along these
 * axes (f->steep). */
static void ip_flow_turn(ip_context *c)
{
  enum { N = IP_NV };
  ip_flow *f = &c->flow;
  double *C = f->work, *V = C + N * N, slope[N];
  const int n = f->left;
  int i, k;
  memcpy(slope, f->steep, sizeof slope);
  for (k = 0; k < n; ++k) {
    const double ease = 1.0 / sqrt(fmax(fabs(C[k * (n + 1)]), c->p.flow_mu[0]));
    ip_scaled(V + k * n, ease, V + k * n, n);
    f->steep[k] = ip_dot(V + k * n, slope, n);
  }
  /* V' overwrites C. */
  for (i = 0; i < n; ++i) {
    for (k = 0; k < n; ++k) {
      C[i * n + k] = V[k * n + i];
    }
  }
  for (i = 0; i < N; ++i) {
    ip_combine(f->axes + i * n, n, f->Z[0] + i, N, C, n, n);
  }
}

/* Update the estimates of the curvature and of the slope of the static controls along f->z, from the reduced gradient
 * and the static controls at the distance f->length along f->z from the last evaluated posture. */
static void ip_flow_learn(ip_flow *f, const double *slope, const double *shares)
{
  const double *z = f->z, length = f->length;
  double missing[IP_NV], along;
  int i;
  for (i = 0; i < IP_NV; ++i) {
    missing[i] = (slope[i] - f->reduced[i]) / length - ip_dot(f->B + i * IP_NV, z, IP_NV);
  }
  along = ip_dot(z, missing, IP_NV) / 2.0;
  ip_add(missing, -along, z, IP_NV);
  for (i = 0; i < IP_NV; ++i) {
    ip_add(f->B + i * IP_NV, missing[i], z, IP_NV);
    ip_add(f->B + i * IP_NV, z[i], missing, IP_NV);
  }
  for (i = 0; i < IP_CONTROLS; ++i) {
    ip_add(f->T[i], (shares[i] - f->shares[i]) / length - ip_dot(f->T[i], z, IP_NV), z, IP_NV);
  }
}

/* Remove from a change of the flow velocity the part that increases H, at the present q_r or after the displacement
 * `stop` of braking. */
static void ip_flow_downhill(const ip_flow *f, const double *stop, double *step)
{
  double uphill[IP_NV], climb;
  int i, k;
  for (k = 0; k < 2; ++k) {
    for (i = 0; i < IP_NV; ++i) {
      uphill[i] = f->slope[i] + (k ? 0.0 : ip_dot(f->B + i * IP_NV, stop, IP_NV));
    }
    ip_flow_project(f, uphill);
    climb = ip_dot(uphill, f->flow, IP_NV) + ip_dot(uphill, step, IP_NV);
    if (climb > 0.0) {
      ip_add(step, -climb / ip_dot(uphill, uphill, IP_NV), uphill, IP_NV);
    }
  }
}

/* Return the time in which a constant deceleration stops the flow.  The braking distance is half the present speed
 * times this time. */
static double ip_flow_stopping(const ip_flow *f, const ip_params *p)
{
  return ip_largest(f->flow, 0) / p->flow_acceleration[0];
}
