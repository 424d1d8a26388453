/* The reference flow: a posture q_r that goes down the gradient on contacts and tasks, limited in speed and acceleration,
 * before the posture task follows it.  An update takes IP_FLOW_PHASES ticks, so that none takes much longer than without it.
 * The formulas are in impact_posture/tsid/flow/reference_flow.py. */

/* Ticks of an update, from its look to the change of the motion, and from the last change to the look. */
#define IP_FLOW_PHASES 14
#define IP_FLOW_UNTIL 4
#define IP_FLOW_SINCE 3

/* Step of the differences, rad; step below which a posture on the way is reached, rad (m). */
#define IP_PROBE 1e-4
#define IP_REACHED 0.02
/* Way of the flow that is long enough to learn from, rad (m). */
#define IP_MOVED 1e-6
/* Length of what is new in a direction below which it is taken twice. */
#define IP_NEW 0.1
/* Length of a velocity below which the flow has no way to stop on. */
#define IP_SLOW 1e-3

/* Model and rows of the constraints at a posture at rest; their errors too, where they are wanted. */
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

/* The objective and its gradient over H0 at a posture; zero where they do not exist. */
static void ip_flow_evaluate(ip_flow *f, const double *q, double *slope)
{
  double value;
  int i;
  f->failed = IP_GRADIENT(&f->m, q, &value, slope) != 0 || !isfinite(value + ip_dot(slope, slope, IP_NV));
  f->found = f->failed ? NAN : value;
  for (i = 0; i < IP_NV; ++i) {
    slope[i] = f->failed ? 0.0 : slope[i] / f->start;
  }
}

/* The gradient on the constraints, slope - J'multiplier, in place. */
static void ip_flow_reduce(const ip_flow *f, double (*J)[IP_NV], double *slope)
{
  int i;
  for (i = 0; i < IP_HELD; ++i) {
    ip_add(slope, -f->multiplier[i], J[i], IP_NV);
  }
}

/* Evaluate objective and constraints where q_r is when the governor changes its motion. */
static void ip_flow_look(ip_context *c)
{
  ip_flow *f = &c->flow;
  double ahead[IP_NQ], way[IP_NV];
  const double dt = f->elapsed / IP_FLOW_SINCE;
  memcpy(way, f->velocity, sizeof way);
  ip_add(way, (IP_FLOW_UNTIL + 1) / 2.0 * dt, f->acceleration, IP_NV);
  ip_integrate(f->q, way, IP_FLOW_UNTIL * dt, ahead);
  ip_difference(ahead, f->here, f->z);
  f->length = sqrt(ip_dot(f->z, f->z, IP_NV));
  memcpy(f->here, ahead, sizeof f->here);
  memcpy(f->there, f->slope, sizeof f->there);
  ip_flow_place(c, f->here, f->error);
  ip_flow_evaluate(f, f->here, f->slope);
  f->value = f->found;
  memcpy(f->shared, f->shares, sizeof f->shared);
  ip_flow_shares(c, f->shares);
}

/* Find the redundancy, and the gradient on it. */
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

/* Learn from the way since the last look, find the limits, and prepare the return. */
static void ip_flow_limit(ip_context *c)
{
  ip_flow *f = &c->flow;
  /* A look that failed has no slope. */
  if (f->length > IP_MOVED && !f->failed && ip_dot(f->there, f->there, IP_NV) > 0.0) {
    ip_flow_reduce(f, f->before, f->there);
    ip_scaled(f->z, 1.0 / f->length, f->z, IP_NV);
    ip_flow_learn(f, f->there, f->shared);
  }
  memcpy(f->before, f->J, sizeof f->before);
  ip_flow_limits(c);
  ip_flow_still(f);
}

/* A direction of the redundancy that does not depend on its basis: what is new of a fixed one. */
static void ip_flow_aim(ip_flow *f)
{
  double *z = f->seen[f->probed], *was = f->work, s;
  int i, k, again;
  for (i = 0; i < IP_NV; ++i) {
    const uint32_t j = (uint32_t)(f->probed * IP_NV + i + 1);
    z[i] = (double)(uint32_t)(j * j * UINT32_C(2654435769)) / 4294967296.0 - 0.5;
  }
  /* Where little of the direction is new, once more makes it exact. */
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

/* Evaluate the gradient where the flow would stop, in every other update, or beside the posture of the last look. */
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

/* Learn from it, by the gradient on the constraints and the static controls there. */
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

/* The parts of finding the eigenvalues of the curvature. */
static void ip_flow_curve(ip_context *c)
{
  ip_flow *f = &c->flow;
  if (ip_flow_descends(f)) {
    ip_flow_bend(c);
  }
}

static void ip_flow_tridiagonal(ip_context *c)
{
  ip_flow *f = &c->flow;
  if (ip_flow_descends(f)) {
    ip_tridiagonal(f->work, f->work + IP_NV * IP_NV, f->left);
  }
}

static void ip_flow_diagonalize(ip_context *c)
{
  ip_flow *f = &c->flow;
  if (ip_flow_descends(f)) {
    ip_diagonalize(f->work, f->work + IP_NV * IP_NV, f->left, f->left * f->left / 2);
  }
}

static void ip_flow_variables(ip_context *c)
{
  ip_flow *f = &c->flow;
  if (ip_flow_descends(f)) {
    ip_diagonalize(f->work, f->work + IP_NV * IP_NV, f->left, 30 * f->left * f->left);
    ip_flow_turn(c);
    ip_flow_rows(f);
  }
}

/* Find the step, and whether it is worth moving. */
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
    double way[IP_NV];
    int i, k;
    ip_difference(f->q, c->p.flow_path + f->visited * IP_NQ, way);
    for (k = 0; k < f->left; ++k) {
      f->steep[k] = -ip_dot(f->Z[k], way, IP_NV);
      for (i = 0; i < IP_NV; ++i) {
        f->way[i * f->left + k] = f->Z[k][i];
      }
    }
    ip_flow_rows(f);
    ip_flow_solve(f);
    f->visited += f->failures == before && ip_largest(f->wanted, 0) < IP_REACHED;
    return;
  }
#endif
  ip_flow_solve(f);
  /* The flow does not climb for what the pull or the springs win. */
  f->gain = fmin(f->gain * ip_flow_root(f), -ip_dot(f->slope, f->wanted, IP_NV));
  f->resting = f->gain < (f->resting ? 4.0 : 1.0) * c->p.flow_epsilon[0] || f->remains <= 0.0;
  if (f->resting) {
    /* It brakes as it turns, downhill. */
    memset(f->wanted, 0, sizeof f->wanted);
  }
}
