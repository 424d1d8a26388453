/* Motion of the reference flow: its governor, its start, and the tasks that follow the flow. */

/* Scale x down so that no absolute value of an entry exceeds `most`. */
static void ip_shorten(double *x, double most)
{
  const double size = ip_largest(x, 0);
  if (size > most) {
    ip_scaled(x, most / size, x, IP_NV);
  }
}

/* Compute the velocity that changes the constraints at `rate` and moves the joints least.  Call ip_flow_still first. */
static void ip_flow_moving(const ip_flow *f, const double *rate, double *back)
{
  int i;
  for (i = 0; i < IP_NV; ++i) {
    back[i] = ip_dot(f->inverse + i * IP_HELD, rate, IP_HELD);
  }
#if IP_BASE
  if (f->stills) {
    double x[IP_NV];
    int k;
    for (k = 0; k < f->left; ++k) {
      x[k] = ip_dot(f->Z[k] + IP_BASE, back + IP_BASE, IP_JOINTS_V);
    }
    ip_solve_factor(f->joints, f->left, x);
    for (k = 0; k < f->left; ++k) {
      ip_add(back, -x[k], f->Z[k], IP_NV);
    }
  }
#endif
}

/* Compute the velocity with which q_r returns to contacts and tasks, with limited speed and acceleration, plus the
 * velocity of moving tasks. */
static void ip_flow_back(ip_context *c, double period, double *back)
{
  ip_flow *f = &c->flow;
  const ip_params *p = &c->p;
  double rate[IP_LARGEST] = {0}, change[IP_NV], size, pace;
  int i, k, row;
  ip_flow_moving(f, f->error, back);
  size = fmax(ip_largest(back, 0), IP_TINY);
  /* The deceleration 2a/5 stops a motion with the speed sqrt(4ad/5) within the distance d. */
  pace = fmin(fmin(1.0 / IP_RETURN, sqrt(0.8 * p->flow_acceleration[0] / size)), p->flow_speed[0] / size);
  for (i = 0; i < IP_NV; ++i) {
    change[i] = pace * back[i] - f->returning[i];
  }
  ip_shorten(change, p->flow_acceleration[0] * period);
  ip_add(f->returning, 1.0, change, IP_NV);
  for (k = 0, row = IP_FORCES; k < IP_TASKS; ++k) {
    for (i = 0; !ip_flow_led[k] && i < ip_task_row[k + 1] - ip_task_row[k]; ++i) {
      rate[row++] = c->target[k].velocity[i];
    }
  }
  ip_flow_moving(f, rate, back);
  ip_add(back, 1.0, f->returning, IP_NV);
}

/* Return the time in which the velocity after `step` covers the distance of this change and of the braking after it.
 * The deceleration is the deceleration that the actuators permitted in the last changes. */
static double ip_flow_braking(const ip_flow *f, const ip_params *p, const double *step, double period)
{
  double after[IP_NV];
  ip_flow_after(f, step, 1.0, after);
  return IP_CAUTION * ip_largest(after, 0) / (2.0 * f->able * p->flow_acceleration[0]) + period;
}

/* Return whether the flow stays within the limits during its braking time. */
static int ip_flow_stops(const ip_flow *f, const ip_params *p, const double *step, double period)
{
  const double time = ip_flow_braking(f, p, step, period);
  double moved[IP_NV];
  int r;
  ip_flow_after(f, step, time, moved);
  for (r = 0; r < IP_FLOW_ROWS; ++r) {
    const double ahead = ip_flow_ahead(f, r, moved);
    if (ahead > f->room[0][r] + IP_NEAR || ahead < f->room[1][r] - IP_NEAR) {
      return 0;
    }
  }
  return 1;
}

/* Limit a change so that the flow stays within its speed limit.  The removal of a part that crosses a limit can speed
 * up other joints. */
static void ip_flow_bound_speed(const ip_flow *f, const ip_params *p, double *step)
{
  double after[IP_NV];
  ip_flow_after(f, step, 1.0, after);
  if (ip_largest(after, 0) > p->flow_speed[0]) {
    ip_shorten(after, p->flow_speed[0]);
    ip_subtract(after, f->flow, step, IP_NV);
  }
}

/* Compute the change of the flow towards the wanted step, as in FlowGovernor.change.  Return whether the change only
 * slows the flow down. */
static int ip_flow_change(const ip_flow *f, const ip_params *p, double period, double fastest, double *step)
{
  enum { N = IP_NV, FAST = 0, BRAKE = 2 };
  const double a = p->flow_acceleration[0], most = a * period, time = ip_flow_stopping(f, p);
  /* The deceleration 2a/5 stops a motion with the speed sqrt(4ad/5) within the step d. */
  const double pace = fmin(sqrt(0.8 * a / fmax(ip_largest(f->wanted, 0), IP_TINY)), IP_RATE);
  const int descends = fastest > 0.0 && f->visited == IP_PATH;
  double wanted[N], stop[N];
  int i, k, attempt;
  for (i = 0; i < N; ++i) {
    wanted[i] = pace * f->wanted[i];
    /* The displacement `stop` is twice the braking distance, because the curvature may increase during braking. */
    stop[i] = time * f->flow[i];
  }
  ip_shorten(wanted, fastest);
  for (k = FAST; k < BRAKE; ++k) {
    for (i = 0; i < N; ++i) {
      step[i] = wanted[i] - f->flow[i];
      step[i] = k == FAST ? fmin(fmax(step[i], -most), most) : step[i];
    }
    if (k == FAST) {
      ip_flow_project(f, step);
    }
    ip_shorten(step, most);
    for (attempt = 0; attempt < IP_ATTEMPTS; ++attempt) {
      if (k == FAST && ip_dot(step, f->flow, N) >= 0.0) {
        ip_flow_keep_zmp(f, period, step);
      }
      if (attempt) {
        ip_flow_along_limits(f, ip_flow_braking(f, p, step, period), step);
      }
      if (descends) {
        ip_flow_downhill(f, stop, step);
      }
      ip_flow_bound_speed(f, p, step);
      ip_shorten(step, most);
      if (ip_flow_stops(f, p, step, period)) {
        return 0;
      }
    }
  }
  ip_scaled(f->flow, -1.0, step, N);
  ip_shorten(step, most);
  return 1;
}

/* Set the acceleration within all limits, including the acceleration of the return to contacts and tasks. */
static void ip_flow_govern(ip_context *c)
{
  enum { N = IP_NV };
  ip_flow *f = &c->flow;
  const ip_params *p = &c->p;
  const double period = f->elapsed;
  double e[N], back[N], step[N], known[N], more[N], fastest, part;
  int i, brakes;
  f->elapsed = 0.0;
  if (!(period > 0.0)) {
    return;
  }
  ip_difference(c->q, f->q, e);
  fastest = p->flow_speed[0] * fmax(1.0 - ip_largest(e, IP_BASE) / p->flow_tracking[0], 0.0);
  if (f->on && !f->resting && f->visited == IP_PATH) {
    f->moved += period;
  }
  /* The flow keeps its speed until the next change.  From the next change on, 2/5 of the largest acceleration must
   * suffice to stop the flow in the remaining time. */
  f->remains = fmin(f->deadline - f->clock, p->flow_duration[0] - f->moved) - 2.0 * period;
  fastest = fmin(fastest, 0.4 * p->flow_acceleration[0] * fmax(f->remains, 0.0));
  fastest = f->on ? fastest : 0.0;
  ip_flow_back(c, period, back);
  /* The constraints change with the posture, and the projection on them can speed up a joint. */
  ip_flow_project(f, f->flow);
  ip_shorten(f->flow, p->flow_speed[0]);
  for (i = 0; i < N; ++i) {
    known[i] = (f->flow[i] + back[i] - f->velocity[i]) / period;
  }
  ip_flow_limit_zmp(f, known);
  brakes = ip_flow_change(f, p, period, fastest, step);
  for (i = 0; i < N; ++i) {
    more[i] = step[i] / period;
  }
  /* Braking may use a larger fraction of the remaining range of the actuators than acceleration. */
  part = ip_flow_permitted(c, known, more, brakes ? (1.0 + p->flow_haste[0]) / 2.0 : p->flow_haste[0]);
  f->able = fmin(fmax(part, IP_ABLE), f->able + IP_ABLE);
  ip_add(f->flow, part, step, N);
  ip_add(known, part, more, N);
  memcpy(f->acceleration, known, sizeof known);
}

/* Time for which the flow rests before a known impact, s: four time constants of the slowest joint. */
static double ip_flow_settle(const ip_params *p)
{
  double slowest = INFINITY;
  int i;
  for (i = IP_BASE; i < IP_NV; ++i) {
    slowest = fmin(slowest, p->posture_kp[i]);
  }
  return slowest > 0.0 && isfinite(slowest) ? 4.0 / sqrt(slowest) : 0.0;
}

/* Return whether the flow is on or still moves. */
static int ip_flow_moves(const ip_flow *f)
{
  return f->on || ip_largest(f->velocity, 0) > 0.0;
}

/* Set the flow to a posture at rest, and begin a new update. */
static void ip_flow_start_at(ip_flow *f, const double *q)
{
  memcpy(f->q, q, sizeof f->q);
  memcpy(f->first, q, sizeof f->first);
  memcpy(f->here, q, sizeof f->here);
  memset(f->velocity, 0, sizeof f->velocity);
  memset(f->acceleration, 0, sizeof f->acceleration);
  memset(f->flow, 0, sizeof f->flow);
  memset(f->returning, 0, sizeof f->returning);
  f->elapsed = 0.0;
  f->phase = f->resting = 0;
}

/* Begin at rest at the present posture, and measure the curvature at this posture.  Return 0 if the objective does
 * not exist or is zero. */
static int ip_flow_begin(ip_context *c)
{
  ip_flow *f = &c->flow;
  int i, k, row = IP_FORCES;
  memset(f, 0, sizeof *f);
  ip_flow_start_at(f, c->q);
  f->deadline = f->remains = INFINITY;
  f->able = 1.0;
  IP_CONSTANTS(c, &f->m);
  for (k = 0; k < IP_TASKS; ++k) {
    if (!ip_flow_led[k]) {
      ip_constant_rows(k, f->J[row]);
      row += ip_task_row[k + 1] - ip_task_row[k];
    }
  }
  for (i = 0; row < IP_HELD; ++i, ++row) {
    f->J[row][ip_flow_fixed[i]] = 1.0;
  }
#if IP_CONTACTS
  ip_flow_polygon(c);
#endif
  f->start = 1.0;
  f->start = fabs(ip_flow_evaluate(f, f->q, f->slope));
  if (f->failed || f->start == 0.0) {
    return 0;
  }
  ip_flow_look(c);
  ip_flow_decompose(c);
  ip_flow_split(c);
  ip_flow_limit(c);
  for (k = 0; k < f->left; ++k) {
    ip_flow_probe(c);
    ip_flow_compare(c);
  }
  f->next = 0;
  c->value = f->value;
  return 1;
}

/* Do the part of the eigenvalue decomposition of the curvature that is due at this tick.  At the tick of the last
 * part, also compute the axes of the Newton step. */
static void ip_flow_curve(ip_context *c)
{
  enum { BEND = 7, TRIDIAGONAL = 8, LAST = 12 };
  ip_flow *f = &c->flow;
  double *A = f->work, *V = A + IP_NV * IP_NV;
  const int n = f->left;
  if (f->failed || f->visited < IP_PATH) {
    return;
  }
  if (f->phase == BEND) {
    ip_flow_bend(c);
  } else if (f->phase == TRIDIAGONAL) {
    ip_tridiagonal(A, V, n);
  } else {
    ip_diagonalize(A, V, n, f->phase == LAST ? 30 * n * n : n * n / 2);
  }
  if (f->phase == LAST) {
    ip_flow_turn(c);
    ip_flow_rows(f);
  }
}

/* Advance the flow by dt seconds, and move the targets of the posture task and of the tasks that follow the flow. */
static void ip_flow_lead(ip_context *c, double dt)
{
  /* The ticks of ip_flow_look, ip_flow_govern and ip_flow_direct are the same as in Python. */
  static void (*const parts[IP_UPDATE_TICKS])(ip_context *) = {
    ip_flow_look,    ip_flow_decompose, ip_flow_split, ip_flow_limit, ip_flow_govern, ip_flow_probe, ip_flow_compare,
    ip_flow_curve,   ip_flow_curve,     ip_flow_curve, ip_flow_curve, ip_flow_govern, ip_flow_curve, ip_flow_direct,
  };
  ip_flow *f = &c->flow;
  int k;
  if (!ip_flow_moves(f)) {
    return;
  }
  f->clock += dt;
  f->elapsed += dt;
  parts[f->phase](c);
  f->phase = (f->phase + 1) % IP_UPDATE_TICKS;
  ip_add(f->velocity, dt, f->acceleration, IP_NV);
  ip_integrate(f->q, f->velocity, dt, f->q);
  if (!f->on && ip_largest(f->velocity, 0) <= IP_STILL) {
    memset(f->velocity, 0, sizeof f->velocity);
    memset(f->acceleration, 0, sizeof f->acceleration);
  }
  c->value = f->value;
  memcpy(c->posture, f->q, sizeof c->posture);
  c->blend = 1.0;
  memcpy(c->posture_velocity, f->velocity, sizeof c->posture_velocity);
  memcpy(c->posture_acceleration, f->acceleration, sizeof c->posture_acceleration);
  for (k = 0; k < IP_TASKS; ++k) {
    ip_target *target = &c->target[k];
    if (!ip_flow_led[k]) {
      continue;
    }
    if (ip_flow_led[k] == 1) {
      /* Compute the model only for the first task that follows the flow, because all other such tasks read the same
       * model. */
      ip_dynamics(f->q, f->velocity, &c->ahead);
    }
    ip_lead_target(target, k, &c->ahead, f->q, f->velocity, f->acceleration);
    /* The next reset sets this target to the present output. */
    target->set = -1.0;
  }
}
