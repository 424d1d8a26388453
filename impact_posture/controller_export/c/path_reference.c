/* References along a path, as in impact_posture.path.path_reference.PathReference. */

/* out = the right Jacobian of the exponential map at z, times x, by the series sum (-ad z)^k x / (k + 1)!. */
static void ip_exponential_rate(const double *z, const double *x, double *out)
{
  int k, i, n;
  memcpy(out, x, sizeof(double) * IP_NV);
  for (k = 0; k < IP_JOINTS; ++k) {
    const double *at = z + ip_joint_v[k];
    const int turns = ip_joint_family[k] == IP_FREE_FLYER ? 3 : 0, size = turns + 3;
    double term[6], next[6], more[3], *sum = out + ip_joint_v[k], largest = 1.0;
    if (ip_joint_family[k] != IP_FREE_FLYER && ip_joint_family[k] != IP_SPHERICAL) {
      continue;
    }
    memcpy(term, sum, sizeof(double) * (size_t)size);
    for (n = 2; n < 64 && largest > 1e-18; ++n) {
      ip_cross(at + turns, term + turns, next + turns);
      if (turns) {
        ip_cross(at + 3, term, next);
        ip_cross(at, term + 3, more);
        ip_add(next, 1.0, more, 3);
      }
      ip_scaled(next, -1.0 / n, term, size);
      for (largest = 0.0, i = 0; i < size; ++i) {
        sum[i] += term[i];
        largest = fmax(largest, fabs(term[i]));
      }
    }
  }
}

/* Write the reference at the time u (0 to 1) of h seconds, from the posture q with the coefficients c of the powers u to u^5. */
static void ip_path_write(ip_path *p, const double *q, const double *c, double u, double h)
{
  double z[IP_NV], dz[IP_NV], ddz[IP_NV];
  int i;
  for (i = 0; i < IP_NV; ++i) {
    const double b = c[i], d = c[IP_NV + i], e = c[2 * IP_NV + i], f = c[3 * IP_NV + i], g = c[4 * IP_NV + i];
    z[i] = u * (b + u * (d + u * (e + u * (f + u * g))));
    dz[i] = (b + u * (2.0 * d + u * (3.0 * e + u * (4.0 * f + u * 5.0 * g)))) / h;
    ddz[i] = (2.0 * d + u * (6.0 * e + u * (12.0 * f + u * 20.0 * g))) / (h * h);
  }
  ip_integrate(q, z, 1.0, p->q);
  ip_exponential_rate(z, dz, p->v);
  ip_exponential_rate(z, ddz, p->a);
}

/* Write the reference at the time t of a motion with n segments.  Each segment has a beginning, a posture and
 * coefficients. */
static void ip_path_follow(ip_path *p, const double *rows, int n, double end, double t)
{
  int low = 0, high = n - 1;
  const double *row;
  double h;
  while (low < high) {
    const int middle = (low + high + 1) / 2;
    if (rows[middle * IP_PATH_ROW] <= t) {
      low = middle;
    } else {
      high = middle - 1;
    }
  }
  row = rows + low * IP_PATH_ROW;
  h = (low + 1 < n ? row[IP_PATH_ROW] : end) - row[0];
  ip_path_write(p, row + 1, row + 1 + IP_NQ, fmin(fmax((t - row[0]) / h, 0.0), 1.0), h);
}

static void ip_path_rest(ip_path *p)
{
  memset(p->v, 0, sizeof p->v);
  memset(p->a, 0, sizeof p->a);
}

/* Return whether the next run-up follows the end of the path from rest, because the path has no rest there. */
static int ip_path_slower(const ip_path *p)
{
  return p->returns && IP_PATH_AGAIN_S > IP_PATH_REST_S;
}

/* Return the time from the end of the wait to the contact. */
static double ip_path_ahead(const ip_path *p)
{
  return ip_path_slower(p) ? 2.0 * (IP_PATH_DURATION_S - IP_PATH_AGAIN_S) : IP_PATH_DURATION_S - IP_PATH_REST_S;
}

static int ip_path_strikes(const ip_path *p, double t)
{
  return t >= p->expected - ip_path_ahead(p);
}

/* Write the reference at the time late <= 0 after the expected contact. */
static void ip_path_before(ip_path *p, double late)
{
  if (ip_path_slower(p)) {
    const double ahead = ip_path_ahead(p), x = 1.0 + late / ahead;
    const double pace = x * x * (3.0 - 2.0 * x), rise = 6.0 * x * (1.0 - x) / ahead;
    int i;
    ip_path_follow(p, ip_path_rows, IP_PATH_SEGMENTS, IP_PATH_DURATION_S,
                   IP_PATH_AGAIN_S + x * x * x * (1.0 - x / 2.0) * ahead);
    for (i = 0; i < IP_NV; ++i) {
      p->a[i] = p->a[i] * pace * pace + p->v[i] * rise;
      p->v[i] *= pace;
    }
  } else {
    ip_path_follow(p, ip_path_rows, IP_PATH_SEGMENTS, IP_PATH_DURATION_S, IP_PATH_DURATION_S + late);
  }
}

/* Set the phase, and write the reference at the time t. */
static void ip_path_at(ip_path *p, double t)
{
  if (!ip_path_strikes(p, t)) {
    const double since = fmin(fmax(t - p->begin, 0.0), p->until);
    const int done = t - p->begin >= p->until;
    p->phase = done && !IP_PATH_STRIKES ? IP_PATH_HOLD : IP_PATH_APPROACH;
    if (p->returns) {
      ip_path_write(p, p->from, p->way, since / p->until, p->until);
    } else {
      ip_path_follow(p, ip_path_rows, IP_PATH_SEGMENTS, IP_PATH_DURATION_S, since);
    }
    if (done) {
      ip_path_rest(p);
    }
  } else if (p->hit == INFINITY) {
    const double late = fmin(t - p->expected, p->late);
    const double run_up = ip_path_slower(p) ? ip_path_ahead(p) : IP_PATH_DURATION_S - IP_PATH_RUN_UP_S;
    p->phase = late > 0.0 ? IP_PATH_LATE : t >= p->expected - run_up ? IP_PATH_RUN_UP : IP_PATH_APPROACH;
    ip_path_before(p, fmin(late, 0.0));
    if (late > 0.0) {
      double q[IP_NQ];
      memcpy(q, p->q, sizeof q);
      ip_integrate(q, p->v, late, p->q);
      memset(p->a, 0, sizeof p->a);
    }
  } else {
    const double since = fmax(t - p->hit, 0.0);
    double away[IP_NV] = {0};
    p->phase = since >= IP_PATH_STOP_S ? IP_PATH_HOLD : IP_PATH_FOLLOW_THROUGH;
    if (IP_PATH_STOP_S > 0.0) {
      ip_path_follow(p, ip_path_stop_rows, IP_PATH_STOP_SEGMENTS, IP_PATH_STOP_S, since);
      ip_difference(ip_path_end, p->q, away);
    }
    ip_integrate(p->contact, away, p->share, p->q);
    if (p->phase == IP_PATH_HOLD) {
      ip_path_rest(p);
    }
    ip_scaled(p->v, p->share, p->v, IP_NV);
    ip_scaled(p->a, p->share, p->a, IP_NV);
  }
}

/* Return whether a measured posture is finite, at most 1e8 in size, and has unit quaternions. */
static int ip_path_measured(const double *q)
{
  int k;
  for (k = 0; k < IP_JOINTS; ++k) {
    const int family = ip_joint_family[k], turns = family == IP_FREE_FLYER ? 3 : 0;
    const int size = family == IP_DIRECT ? 0 : family == IP_CONTINUOUS ? 2 : 4;
    const double *unit = q + ip_joint_q[k] + turns;
    if (size && !(fabs(ip_dot(unit, unit, size) - 1.0) <= 1e-2)) {
      return 0;
    }
  }
  return ip_dot(q, q, IP_NQ) < 1e16;
}

static int ip_path_touches(const ip_path *p, const double *v, double force)
{
  const double planned = ip_dot(ip_path_approach, p->v, IP_NV);
  if (force > p->felt) {
    return 1;
  }
  /* At the beginning of the run-up, the planned speed is too small to be compared with the measured speed. */
  return v && planned * p->stopped > p->stopped * p->stopped * IP_PATH_SPEED
         && ip_dot(ip_path_approach, v, IP_NV) < p->stopped * planned;
}

void ip_path_init(ip_path *p)
{
  memset(p, 0, sizeof *p);
  memcpy(p->q, ip_path_rows + 1, sizeof p->q);
  p->late = ip_path_defaults[0];
  p->felt = ip_path_defaults[1];
  p->stopped = ip_path_defaults[2];
  p->lag = ip_path_defaults[3];
  p->begin = p->expected = p->hit = INFINITY;
  p->now = -INFINITY;
}

int ip_path_start(ip_path *p, double t, double contact)
{
  if (!isfinite(t) || isnan(contact) || !(p->late >= 0.0 && p->late <= 10.0) || isnan(p->felt) || isnan(p->stopped)
      || !(p->lag >= 0.0 && p->lag <= 10.0)) {
    return 1;
  }
  p->phase = IP_PATH_APPROACH;
  p->returns = 0;
  p->until = IP_PATH_REST_S;
  p->begin = p->now = t;
  p->expected = p->hit = INFINITY;
  return IP_PATH_STRIKES ? ip_path_expect(p, contact) : 0;
}

int ip_path_expect(ip_path *p, double contact)
{
  if (!IP_PATH_STRIKES || isnan(contact) || p->phase != IP_PATH_APPROACH || ip_path_strikes(p, p->now)) {
    return 1;
  }
  p->expected = fmax(contact, fmax(p->begin + p->until, p->now) + ip_path_ahead(p));
  return 0;
}

int ip_path_return(ip_path *p, double over)
{
  static const double share[5] = {0.0, 0.0, 10.0, -15.0, 6.0};
  double here[IP_NQ], away[IP_NV];
  int k;
  if (p->hit == INFINITY || !(over >= 1e-3 && over <= 1e8)) {
    return 1;
  }
  memcpy(p->from, p->q, sizeof p->from);
  ip_path_follow(p, ip_path_rows, IP_PATH_SEGMENTS, IP_PATH_DURATION_S, IP_PATH_AGAIN_S);
  memcpy(here, p->q, sizeof here);
  memcpy(p->q, p->from, sizeof p->q);
  ip_path_rest(p);
  ip_difference(p->from, here, away);
  for (k = 0; k < 5; ++k) {
    ip_scaled(away, share[k], p->way + k * IP_NV, IP_NV);
  }
  p->phase = IP_PATH_APPROACH;
  p->returns = 1;
  p->until = over;
  p->begin = p->now;
  p->expected = p->hit = INFINITY;
  return 0;
}

int ip_path_tick(ip_path *p, double t, const double q[IP_NQ], const double *v, double force)
{
  double ahead[IP_NV];
  if (!isfinite(t) || p->phase == IP_PATH_IDLE) {
    return p->phase;
  }
  p->now = t;
  if (ip_path_strikes(p, t) && p->hit == INFINITY) {
    ip_path_at(p, t);
    /* The test is not ">", because ">" is false for NaN. */
    const int late = !(t <= p->expected + p->late);
    if (late || (p->phase != IP_PATH_APPROACH && ip_path_touches(p, v, force))) {
      /* The velocity after an impact is proportional to the velocity before. */
      const double share = ip_dot(p->v, ip_path_velocity, IP_NV) / ip_dot(ip_path_velocity, ip_path_velocity, IP_NV);
      p->hit = t;
      p->share = late ? 1.0 : fmin(fmax(share, 0.0), 1.0);
      memcpy(p->contact, late && ip_path_measured(q) ? q : p->q, sizeof p->contact);
    }
  }
  ip_path_at(p, t + p->lag);
  memcpy(ahead, p->a, sizeof ahead);
  ip_path_at(p, t);
  memcpy(p->a, ahead, sizeof p->a);
  return p->phase;
}
