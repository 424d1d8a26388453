/* Functions of the header: reset, tick, and changes of targets and phases. */

/* Times with a smaller difference, s, are equal, because sums of periods are not exact. */
#define IP_SAME 1e-9

/* Return whether a quaternion or a pair (cosine, sine) in q is far from unit length. */
static int ip_turned_wrong(const double *q)
{
  int k;
  for (k = 0; k < IP_UNITS; ++k) {
    const double *unit = q + ip_unit[2 * k];
    if (!(fabs(ip_dot(unit, unit, ip_unit[2 * k + 1]) - 1.0) <= 1e-2)) {
      return 1;
    }
  }
  return 0;
}

static void ip_write(ip_context *c, const double *u, int status, ip_command *out)
{
  int i;
  c->status = status;
  memcpy(out->u, u, sizeof(double) * IP_CONTROLS);
  for (i = 0; i < IP_ROTORS; ++i) {
    out->rotor_speed[i] = sqrt(fmax(u[i], 0.0) / c->p.thrust_coefficient[0]);
  }
  for (i = 0; i < IP_NV; ++i) {
    out->acceleration[i] = c->held_now ? 0.0 : c->z[i];
  }
  for (i = 0; i < IP_FORCES; ++i) {
    out->forces[i] = c->held_now ? 0.0 : c->z[IP_NV + IP_SPARE + i];
  }
  out->status = status;
  out->iterations = c->iterations;
}

/* Write the previous command, with damping of the joints whose measured rates are valid. */
static void ip_hold(ip_context *c, int status, const double *v, ip_command *out)
{
  double u[IP_CONTROLS];
  int i;
  for (i = 0; i < IP_CONTROLS; ++i) {
    const int k = IP_BASE + i - IP_ROTORS;
    u[i] = c->held[i] - (i >= IP_ROTORS && fabs(v[k]) < sqrt(IP_ABSURD) ? c->damping[k] * v[k] : 0.0);
    u[i] = fmin(fmax(u[i], c->p.control_lower[i]), c->p.control_upper[i]);
  }
  c->held_now = 1;
  ip_write(c, u, status, out);
}

static void ip_build(ip_context *c)
{
  int k;
  for (k = 0; k < IP_TASKS; ++k) {
    ip_task_rows(c, k);
  }
  ip_contact_rows(c);
  ip_posture_wanted(c);
  memcpy(c->free_force, c->m.h, sizeof(double) * IP_NV);
#if IP_FORCE_POINT >= 0
  for (k = 0; k < 6 && c->pushed; ++k) {
    ip_add(c->free_force, -c->force[k], c->m.jacobian[IP_FORCE_POINT] + k * IP_NV, IP_NV);
  }
#endif
}

/* Solve the QP in the context and write the command. */
static void ip_answer(ip_context *c, ip_command *out)
{
  double u[IP_CONTROLS], over = 0.0;
  int i, flag, relaxed = 0;
  if (!isfinite(c->sum)) {
    ip_cool(c);
    ip_hold(c, IP_NON_FINITE, c->v, out);
    return;
  }
  memset(c->gave, 0, sizeof c->gave);
  memset(c->missed, 0, sizeof c->missed);
  if (!c->independent) {
    ip_cool(c);
  }
  flag = c->independent ? ip_solve_warm(c) : 0;
  if (c->independent && flag <= 0 && flag != DAQP_EXIT_INFEASIBLE) {
    /* The solver failed from the active set of the last tick, so start without an active set. */
    flag = ip_solve_warm(c);
  }
  if (flag <= 0 && !ip_relax(c)) {
    ip_hold(c, flag == DAQP_EXIT_INFEASIBLE ? IP_INFEASIBLE : IP_UNSOLVED, c->v, out);
    return;
  }
  for (i = 0; i < IP_CONTROLS; ++i) {
    const int r = IP_EQUATIONS + i;
    const double exact = c->known[i] + ip_dot(c->rows[r], c->z, IP_VARIABLES);
    u[i] = ip_least(ip_most(exact, c->p.control_lower[i]), c->p.control_upper[i]);
    over += (exact - u[i]) * (exact - u[i]);
  }
  /* The test is not ">", because ">" is false for NaN. */
  if (!(over <= c->excess * c->excess)) {
    ip_hold(c, IP_UNSOLVED, c->v, out);
    return;
  }
  for (i = 0; i < 1 + IP_LEVELS; ++i) {
    relaxed |= c->gave[i] > 0.0;
  }
  c->held_now = 0;
  memcpy(c->held, u, sizeof u);
  ip_write(c, u, relaxed ? IP_RELAXED : IP_SOLVED, out);
}

/* Return whether a measurement can be used. */
static int ip_measured(const double *q, const double *v, const double *force)
{
  double total = ip_dot(q, q, IP_NQ) + ip_dot(v, v, IP_NV);
  total += force ? ip_dot(force, force, 6) : 0.0;
  /* If the sum of squares is finite and below the bound, every number is finite and bounded too. */
  return total < IP_ABSURD && !ip_turned_wrong(q);
}

int ip_reset(ip_context *c, const double q[IP_NQ], const double v[IP_NV], ip_command *out)
{
  static const double upward[3] = {0.0, 0.0, 1.0};
  int i, k;
  if (!ip_measured(q, v, NULL)) {
    return 1;
  }
  c->pushed = c->iterations = 0;
  ip_read_state(c, q, v);
  if (ip_on_edge(c)) {
    return 3;
  }
  for (k = 0; k < IP_TASKS; ++k) {
    ip_constant_rows(k, c->J[ip_task_row[k]]);
    if (c->target[k].set < 0.0) {
      /* A reference flow has moved this target. */
      memset(&c->target[k], 0, sizeof c->target[k]);
    }
    if (c->target[k].set <= 0.0) {
      ip_present(&c->m, c->q, k, &c->target[k]);
      if (ip_task_kind[k] == IP_TILT) {
        memcpy(c->target[k].position, upward, sizeof upward);
      }
    }
  }
  ip_reset_posture(c);
  ip_hold_contacts(c);
  ip_begin_qp(c);
  memset(c->relaxation, 0, sizeof c->relaxation);
  ip_build(c);
#if IP_ROBUST
  if (!ip_normalize(c)) {
    return 2;
  }
#endif
#if IP_FLOW
  if (!ip_flow_begin(c)) {
    return 2;
  }
#endif
  ip_assemble(c);
  ip_begin_rank(c);
  for (i = 0; i < IP_NV; ++i) {
    c->damping[i] = 10.0 * c->m.M[i * (IP_NV + 1)];
  }
  /* This command balances gravity.  The first tick repeats it if the QP has no valid solution. */
  for (i = 0; i < IP_CONTROLS; ++i) {
    const double *h = c->m.h;
    const double force = i < IP_ROTORS ? ip_dot(ip_inverse + i * IP_BASE, h, IP_BASE) : h[IP_BASE + i - IP_ROTORS];
    c->held[i] = fmin(fmax(force, c->p.control_lower[i]), c->p.control_upper[i]);
  }
  ip_answer(c, out);
  ip_cool(c);
  c->last = NAN;
  c->ready = 1;
  return 0;
}

int ip_tick(ip_context *c, double t, const double q[IP_NQ], const double v[IP_NV], const double *force,
            ip_command *out)
{
  const double longest = IP_LONGEST * c->p.period[0];
  double dt;
  if (!c->ready) {
    memset(out, 0, sizeof *out);
    out->status = IP_UNSOLVED;
    return IP_UNSOLVED;
  }
  c->iterations = 0;
  if (!isfinite(t) || !ip_measured(q, v, force)) {
    ip_hold(c, IP_NON_FINITE, v, out);
    return out->status;
  }
  dt = isnan(c->last) ? c->p.period[0] : fmin(fmax(t - c->last, 0.0), longest);
  c->last = t;
  c->pushed = force != NULL;
  if (force) {
    memcpy(c->force, force, sizeof c->force);
  }
  ip_read_state(c, q, v);
  while (c->waiting > 0 && t >= c->since[0] - IP_SAME) {
    ip_enter(c);
  }
  ip_advance(c, dt);
  ip_build(c);
  ip_assemble(c);
  ip_measure_rank(c);
  ip_answer(c, out);
  return out->status;
}

int ip_move_to(ip_context *c, const double q[IP_NQ], double over)
{
  if (!c->ready || !(over > 0.0) || !(ip_dot(q, q, IP_NQ) < IP_ABSURD) || ip_turned_wrong(q)) {
    return 1;
  }
  ip_fade_to(c, q, over);
  return 0;
}

int ip_lead_posture(ip_context *c, const double q[IP_NQ], const double v[IP_NV], const double a[IP_NV])
{
  if (!c->ready || !ip_measured(q, v, NULL) || !(ip_dot(a, a, IP_NV) < IP_ABSURD)) {
    return 1;
  }
  memcpy(c->posture, q, sizeof c->posture);
  memcpy(c->posture_velocity, v, sizeof c->posture_velocity);
  memcpy(c->posture_acceleration, a, sizeof c->posture_acceleration);
  c->blend = 1.0;
  return 0;
}

int ip_lead(ip_context *c, const double q[IP_NQ], const double v[IP_NV], const double a[IP_NV])
{
  int k;
  if (ip_lead_posture(c, q, v, a)) {
    return 1;
  }
  ip_dynamics(q, v, &c->ahead);
  for (k = 0; k < IP_TASKS; ++k) {
    ip_lead_target(&c->target[k], k, &c->ahead, q, v, a);
  }
  return 0;
}

int ip_brace(ip_context *c, double t)
{
#if IP_FLOW
  return ip_brace_before(c, t, INFINITY);
#else
  return ip_announce(c, IP_BRACE, t);
#endif
}

#if IP_FLOW
int ip_brace_before(ip_context *c, double t, double t_impact)
{
  if (isnan(t_impact) || ip_announce(c, IP_BRACE, t)) {
    return 1;
  }
  c->impact[c->waiting - 1] = t_impact;
  return 0;
}
#endif

int ip_contact(ip_context *c, double t)
{
  return ip_announce(c, IP_CONTACT, t);
}

int ip_release(ip_context *c, double t)
{
  return ip_announce(c, IP_RELEASE, t);
}
