/* Tasks and joint limits at the state in the context. */

/* Task classes, the values of ip_task_kind. */
enum { IP_TILT, IP_BASE_TURN, IP_MASS_CENTER, IP_POSITION, IP_POSE, IP_ALIGNED };
/* Values of c->phase. */
enum { IP_FREE, IP_BRACE, IP_CONTACT, IP_RELEASE };

static double ip_smooth(double x)
{
  return x * x * (3.0 - 2.0 * x);
}

static void ip_read_state(ip_context *c, const double *q, const double *v)
{
  int i, k;
  memcpy(c->q, q, sizeof(double) * IP_NQ);
  memcpy(c->v, v, sizeof(double) * IP_NV);
  for (k = 0; k < IP_UNITS; ++k) {
    double *unit = c->q + ip_unit[2 * k];
    const double square = ip_dot(unit, unit, ip_unit[2 * k + 1]);
    if (fabs(square - 1.0) > 1e-12) {
      for (i = 0; i < ip_unit[2 * k + 1]; ++i) {
        unit[i] /= sqrt(square);
      }
    }
  }
  c->least_room = INFINITY;
  for (i = 0; i < IP_NV; ++i) {
    const double at = c->q[ip_limit_q[i]];
    c->room[0][i] = c->p.joint_upper[i] - at;
    c->room[1][i] = at - c->p.joint_lower[i];
    c->least_room = fmin(c->least_room, fmin(c->room[0][i], c->room[1][i]));
  }
  ip_dynamics(c->q, c->v, &c->m);
}

/* Compute position, Jacobian (rows of NV numbers) and drift of the center of mass from the base rows of M and h. */
static void ip_center_of_mass(const ip_model *m, const double *q, double *position, double *J, double *drift)
{
#if IP_BASE == 6
  const double *M = m->M, *R = m->base;
  const double mass = M[0], lever[3] = {M[IP_NV + 5], -M[5], M[4]};
  double scaled[9];
  int i;
  ip_scaled(R, 1.0 / mass, scaled, 9);
  ip_turn(scaled, lever, 0, position);
  ip_turn(scaled, m->h, 0, drift);
  for (i = 0; i < 3; ++i) {
    position[i] += q[i];
    drift[i] += ip_gravity[i];
    if (J) {
      ip_combine(J + i * IP_NV, IP_NV, scaled + 3 * i, 1, M, IP_NV, 3);
    }
  }
#else
  (void)m, (void)q, (void)position, (void)J, (void)drift, (void)ip_gravity;
#endif
}

/* Compute the x and y components of the shortest rotation (angle times axis) from the z axis to a unit vector. */
static void ip_shortest(const double *to, double *e)
{
  const double sine = hypot(to[0], to[1]);
  if (sine < 1e-12) {
    /* Upside down, all horizontal rotation axes are equally good, so the code selects the x axis. */
    e[0] = to[2] > 0.0 ? 0.0 : IP_PI;
    e[1] = 0.0;
  } else {
    const double scale = atan2(sine, to[2]) / sine;
    e[0] = -scale * to[1];
    e[1] = scale * to[0];
  }
}

/* Write the rows of a task whose Jacobian is constant. */
static void ip_constant_rows(int k, double *J)
{
  int i;
  for (i = 0; i < ip_task_row[k + 1] - ip_task_row[k] && ip_task_kind[k] <= IP_BASE_TURN; ++i) {
    J[i * IP_NV + 3 + i] = 1.0;
  }
}

/* Set a target to the output of its task.  m is the model of the robot at q. */
static void ip_present(const ip_model *m, const double *q, int k, ip_target *target)
{
  const int point = ip_task_point[k];
  double drift[3];
  int i;
  switch (ip_task_kind[k]) {
  case IP_TILT:
    for (i = 0; i < 3; ++i) {
      target->position[i] = m->base[3 * i + 2];
    }
    break;
  case IP_BASE_TURN:
    memcpy(target->rotation, m->base, sizeof target->rotation);
    break;
  case IP_MASS_CENTER:
    ip_center_of_mass(m, q, target->position, NULL, drift);
    break;
  default:
    memcpy(target->position, m->position[point], sizeof target->position);
    memcpy(target->rotation, m->rotation[point], sizeof target->rotation);
  }
  target->set = 1.0;
}

/* Compute log6 of the motion to a pose, in world axes.  On input, e[0..2] is the desired origin minus the present
 * origin. */
static void ip_pose_error(const double *R, const double *wanted, double *e)
{
  double relative[9], w[3], p[3], linear[3];
  ip_relative(R, wanted, relative);
  ip_log3(relative, w);
  ip_turn(R, e, 1, p);
  ip_log6_linear(w, p, linear);
  ip_turn(R, linear, 0, e);
  ip_turn(R, w, 0, e + 3);
}

/* Write error e, Jacobian J (unless it is constant) and drift of a task.  m is the model of the robot at q. */
static void ip_task_output(const ip_target *target, int k, const ip_model *m, const double *q, double *J, double *e,
                           double *drift)
{
  const int point = ip_task_point[k];
  const double *axis = ip_task_axis + 9 * k;
  double R[9], w[3] = {0}, p[3];
  int i;
  switch (ip_task_kind[k]) {
  case IP_TILT:
    ip_turn(m->base, target->position, 1, w);
    ip_shortest(w, e);
    break;
  case IP_BASE_TURN:
    ip_relative(m->base, target->rotation, R);
    ip_log3(R, e);
    break;
  case IP_MASS_CENTER:
    ip_center_of_mass(m, q, p, J, drift);
    ip_subtract(target->position, p, e, 3);
    break;
  default:
    ip_subtract(target->position, m->position[point], e, 3);
    memcpy(J, m->jacobian[point], sizeof(double) * 3 * IP_NV);
    memcpy(drift, ip_task_kind[k] == IP_POSE ? m->spatial[point] : m->drift[point], sizeof(double) * 6);
  }
  if (ip_task_kind[k] == IP_POSE) {
    ip_pose_error(m->rotation[point], target->rotation, e);
    memcpy(J + 3 * IP_NV, m->jacobian[point] + 3 * IP_NV, sizeof(double) * 3 * IP_NV);
  } else if (ip_task_kind[k] == IP_ALIGNED) {
    const double *turned = m->rotation[point];
    double wanted[3], across[2][3], cross[3], sine, cosine;
    ip_turn(target->rotation, axis, 0, p);
    ip_turn(turned, p, 1, wanted);
    ip_cross(axis, wanted, cross);
    for (i = 0; i < 2; ++i) {
      e[3 + i] = ip_dot(axis + 3 + 3 * i, cross, 3);
      ip_turn(turned, axis + 3 + 3 * i, 0, across[i]);
    }
    sine = hypot(e[3], e[4]);
    cosine = ip_dot(axis, wanted, 3);
    if (sine >= 1e-12) {
      const double scale = atan2(sine, cosine) / sine;
      e[3] *= scale;
      e[4] *= scale;
    } else if (cosine < 0.0) {
      e[3] = IP_PI;
    }
    for (i = 0; i < 2; ++i) {
      w[i] = ip_dot(across[i], drift + 3, 3);
      ip_combine(J + (3 + i) * IP_NV, IP_NV, across[i], 1, m->jacobian[point] + 3 * IP_NV, IP_NV, 3);
    }
    memcpy(drift + 3, w, sizeof(double) * 2);
  }
}

/* Set a target to the output of its task in the motion (q, v, a).  m is the model of the robot at (q, v). */
static APART void ip_lead_target(ip_target *target, int k, const ip_model *m, const double *q, const double *v,
                                 const double *a)
{
  double e[6], drift[6] = {0}, J[6 * IP_NV] = {0};
  int i;
  ip_present(m, q, k, target);
  ip_constant_rows(k, J);
  ip_task_output(target, k, m, q, J, e, drift);
  for (i = 0; i < ip_task_row[k + 1] - ip_task_row[k]; ++i) {
    target->velocity[i] = ip_dot(J + i * IP_NV, v, IP_NV);
    target->acceleration[i] = ip_dot(J + i * IP_NV, a, IP_NV) + drift[i];
  }
}

/* Write rows J and right-hand sides a = y''* - J'v of a task. */
static void ip_task_rows(ip_context *c, int k)
{
  const int row = ip_task_row[k], size = ip_task_row[k + 1] - row, point = ip_task_point[k];
  const ip_target *target = &c->target[k];
  double e[6], drift[6] = {0}, more[6] = {0}, *J = c->J[row];
  int i;
  ip_task_output(target, k, &c->m, c->q, J, e, drift);
  for (i = 0; c->pushed && ip_task_impedance[k] && i < 6; ++i) {
    more[i] = c->p.task_softness[6 * k + i] * c->force[i];
  }
  if (c->pushed && ip_task_kind[k] == IP_ALIGNED) {
    double local[3];
    ip_turn(c->m.rotation[point], more + 3, 1, local);
    more[3] = ip_dot(ip_task_axis + 9 * k + 3, local, 3);
    more[4] = ip_dot(ip_task_axis + 9 * k + 6, local, 3);
  }
  for (i = 0; i < size; ++i) {
    const double rate = ip_dot(J + i * IP_NV, c->v, IP_NV);
    c->a[row + i] = c->p.task_kp[row + i] * e[i] + c->p.task_kd[row + i] * (target->velocity[i] - rate)
                    + target->acceleration[i] - drift[i] + more[i];
  }
}

/* Compute the bounds on the acceleration of a joint: to[0] towards the upper limit, to[1] towards the lower limit.
 * LimitLaw explains the formulas. */
static void ip_bounds(const ip_context *c, int i, double *to)
{
  const ip_params *p = &c->p;
  const double margin = ip_least(p->law_margin[0], (p->joint_upper[i] - p->joint_lower[i]) / 4.0);
  int s;
  for (s = 0; s < 2; ++s) {
    const double distance = c->room[s][i] - margin, room = fabs(distance);
    double speed = sqrt(2.0 * p->law_deceleration[0] * room);
    speed = ip_least(ip_least(p->law_approach[0] * room, speed), p->joint_velocity[i]);
    speed = copysign(speed, distance) * p->law_rate[0] + (s ? 1.0 : -1.0) * p->law_rate[0] * c->v[i];
    to[s] = i < IP_BASE ? speed : ip_least(ip_most(speed, -p->law_acceleration[0]), p->law_acceleration[0]);
  }
}
