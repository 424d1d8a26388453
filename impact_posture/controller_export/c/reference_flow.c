/* The reference flow: a posture q_r that moves to lower impacts with limited speed and acceleration, while contacts
 * and tasks hold.  The posture task follows q_r.  The work of an update is spread over IP_UPDATE_TICKS ticks, so that
 * all ticks need similar times.  The formulas are in impact_posture/tsid/flow/reference_flow.py. */

/* Evaluate the model and the Jacobian of the constraints at a posture with v = 0.  Write the errors of the
 * constraints if `error` is not null. */
static void ip_flow_place(ip_context *c, const double *q, double *error)
{
  static const double still[IP_NV] = {0};
  ip_flow *f = &c->flow;
  double e[6], drift[6];
  int k, row = 0, size;
  ip_dynamics(q, still, &f->m);
#if IP_CONTACTS
  memcpy(f->base, q, sizeof f->base);
#endif
  for (k = 0; k < IP_CONTACTS; ++k, row += size) {
    const int point = ip_contact_point[k];
    size = ip_contact_row[k + 1] - ip_contact_row[k];
    memcpy(f->J[row], f->m.jacobian[point], sizeof(double) * (size_t)size * IP_NV);
    ip_subtract(c->home_position[k], f->m.position[point], e, 3);
    if (size == 6) {
      ip_pose_error(f->m.rotation[point], c->home_rotation[k], e);
    }
    if (error) {
      memcpy(error + row, e, sizeof(double) * (size_t)size);
    }
  }
  for (k = 0; k < IP_TASKS; ++k) {
    if (ip_flow_led[k]) {
      continue;
    }
    size = ip_task_row[k + 1] - ip_task_row[k];
    ip_task_output(&c->target[k], k, &f->m, q, f->J[row], e, drift);
    if (error) {
      memcpy(error + row, e, sizeof(double) * (size_t)size);
    }
    row += size;
  }
}

/* Return the objective at a posture, and write its gradient divided by H0 to `slope`.  If the gradient does not
 * exist, return NaN and write zeros. */
static double ip_flow_evaluate(ip_flow *f, const double *q, double *slope)
{
  double value;
  int i;
  f->failed = IP_GRADIENT(&f->m, q, &value, slope) != 0 || !isfinite(value + ip_dot(slope, slope, IP_NV));
  for (i = 0; i < IP_NV; ++i) {
    slope[i] = f->failed ? 0.0 : slope[i] / f->start;
  }
  return f->failed ? NAN : value;
}

/* Replace the slope by the reduced gradient, slope - J'multiplier. */
static void ip_flow_reduce(const ip_flow *f, double (*J)[IP_NV], double *slope)
{
  int i;
  for (i = 0; i < IP_HELD; ++i) {
    ip_add(slope, -f->multiplier[i], J[i], IP_NV);
  }
}

/* Evaluate objective and constraints at q_r as predicted for the next change of acceleration. */
static void ip_flow_look(ip_context *c)
{
  ip_flow *f = &c->flow;
  double ahead[IP_NQ], mean[IP_NV];
  const double dt = f->elapsed / IP_SINCE;
  memcpy(mean, f->velocity, sizeof mean);
  ip_add(mean, (IP_UNTIL + 1) / 2.0 * dt, f->acceleration, IP_NV);
  ip_integrate(f->q, mean, IP_UNTIL * dt, ahead);
  ip_difference(ahead, f->here, f->z);
  f->length = sqrt(ip_dot(f->z, f->z, IP_NV));
  memcpy(f->here, ahead, sizeof f->here);
  memcpy(f->there, f->slope, sizeof f->there);
  ip_flow_place(c, f->here, f->error);
  f->value = ip_flow_evaluate(f, f->here, f->slope);
  memcpy(f->shared, f->shares, sizeof f->shared);
  ip_flow_shares(c, f->shares);
}

/* Compute the redundancy and the gradient on the redundancy. */
static void ip_flow_split(ip_context *c)
{
  ip_flow *f = &c->flow;
  int i;
  ip_flow_space(f);
  memset(f->multiplier, 0, sizeof f->multiplier);
  for (i = 0; i < IP_NV; ++i) {
    ip_add(f->multiplier, f->slope[i], f->inverse + i * IP_HELD, IP_HELD);
  }
  memcpy(f->reduced, f->slope, sizeof f->reduced);
  ip_flow_reduce(f, f->J, f->reduced);
}

/* Update the curvature estimates from the displacement since the last evaluation, set the limits, and prepare the
 * return to the constraints. */
static void ip_flow_limit(ip_context *c)
{
  ip_flow *f = &c->flow;
  /* The stored slope is zero if the gradient failed at the last evaluation. */
  if (f->length > IP_MOVED && !f->failed && ip_dot(f->there, f->there, IP_NV) > 0.0) {
    ip_flow_reduce(f, f->before, f->there);
    ip_scaled(f->z, 1.0 / f->length, f->z, IP_NV);
    ip_flow_learn(f, f->there, f->shared);
  }
  memcpy(f->before, f->J, sizeof f->before);
  ip_flow_limits(c);
  ip_flow_still(f);
}

/* Compute the next probe direction from a fixed direction: project it on the redundancy, and remove its components
 * along the earlier probe directions.  The result does not depend on the basis of the redundancy. */
static void ip_flow_aim(ip_flow *f)
{
  double *z = f->seen[f->probed], *was = f->work, s;
  int i, k, again;
  for (i = 0; i < IP_NV; ++i) {
    const uint32_t j = (uint32_t)(f->probed * IP_NV + i + 1);
    z[i] = (double)(uint32_t)(j * j * UINT32_C(2654435769)) / 4294967296.0 - 0.5;
  }
  /* If the remaining vector is short, a second pass removes the rounding errors. */
  for (again = 0, s = 0.0; again < 2 && s < IP_NEW; ++again) {
    memcpy(was, z, sizeof(double) * IP_NV);
    for (k = 0; k < f->probed; ++k) {
      ip_add(z, -ip_dot(f->seen[k], was, IP_NV), f->seen[k], IP_NV);
    }
    ip_flow_project(f, z);
    s = sqrt(fmax(ip_dot(z, z, IP_NV), 1e-24));
    ip_scaled(z, 1.0 / s, z, IP_NV);
  }
}

/* Evaluate the gradient near the last evaluated posture.  In every second update, evaluate the gradient at the
 * posture where the flow would stop. */
static void ip_flow_probe(ip_context *c)
{
  ip_flow *f = &c->flow;
  const double size = sqrt(ip_dot(f->flow, f->flow, IP_NV));
  double q[IP_NQ];
  f->length = 0.0;
  if (f->failed || !f->left) {
    return;
  }
  f->turn = !f->turn;
  if (f->turn && size > IP_SLOW) {
    f->probed = -1;
    f->length = fmax(size * ip_flow_stopping(f, &c->p), IP_PROBE);
    ip_scaled(f->flow, 1.0 / size, f->z, IP_NV);
  } else {
    f->probed = f->next % f->left;
    f->length = IP_PROBE;
    ip_flow_aim(f);
    memcpy(f->z, f->seen[f->probed], sizeof f->z);
  }
  ip_integrate(f->here, f->z, f->length, q);
  ip_flow_evaluate(f, q, f->there);
  ip_flow_place(c, q, NULL);
}

/* Update the curvature estimates from the gradient on the constraints and the static controls at the probe. */
static void ip_flow_compare(ip_context *c)
{
  ip_flow *f = &c->flow;
  double shares[IP_CONTROLS];
  if (f->failed || !(f->length > 0.0)) {
    return;
  }
  ip_flow_reduce(f, f->J, f->there);
  ip_flow_shares(c, shares);
  if (!f->failed) {
    ip_flow_learn(f, f->there, shares);
    f->next += f->probed >= 0;
  }
}

/* Compute the step, and decide whether the flow rests. */
static void ip_flow_direct(ip_context *c)
{
  ip_flow *f = &c->flow;
  memset(f->wanted, 0, sizeof f->wanted);
  if (f->failed) {
    return;
  }
#if IP_PATH
  if (f->visited < IP_PATH) {
    const int before = f->failures;
    double remaining[IP_NV];
    int i, k;
    ip_difference(f->q, c->p.flow_path + f->visited * IP_NQ, remaining);
    for (k = 0; k < f->left; ++k) {
      f->steep[k] = -ip_dot(f->Z[k], remaining, IP_NV);
      for (i = 0; i < IP_NV; ++i) {
        f->axes[i * f->left + k] = f->Z[k][i];
      }
    }
    ip_flow_rows(f);
    ip_flow_solve(f);
    f->visited += f->failures == before && ip_largest(f->wanted, 0) < IP_REACHED;
    return;
  }
#endif
  ip_flow_solve(f);
  /* The step also decreases the distance term and the energy of the springs, but f->gain counts only H. */
  f->gain = fmin(f->gain * ip_flow_root(f), -ip_dot(f->slope, f->wanted, IP_NV));
  f->resting = f->gain < (f->resting ? 4.0 : 1.0) * c->p.flow_epsilon[0] || f->remains <= 0.0;
  if (f->resting) {
    /* With a zero step, the governor brakes the flow without raising H. */
    memset(f->wanted, 0, sizeof f->wanted);
  }
}
