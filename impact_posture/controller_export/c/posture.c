/* Posture task: fades of q_des, and the impact-robust term with its phases. */

/* Set q_des to the posture that a fade has reached, with zero velocity and acceleration. */
static void ip_stop_fade(ip_context *c)
{
  double step[IP_NV];
  if (c->blend < 1.0) {
    ip_difference(c->posture, c->next, step);
    ip_integrate(c->posture, step, ip_smooth(c->blend), c->posture);
    c->blend = 1.0;
  }
  memset(c->posture_velocity, 0, sizeof c->posture_velocity);
  memset(c->posture_acceleration, 0, sizeof c->posture_acceleration);
}

static void ip_fade_to(ip_context *c, const double *q, double over)
{
  ip_stop_fade(c);
  memcpy(c->next, q, sizeof c->next);
  c->blend = 0.0;
  c->over = over;
}

#if IP_ROBUST
/* Evaluate the impact-robust term at q; if the gradient does not exist, keep the previous term. */
static void ip_evaluate(ip_context *c)
{
  double term[IP_NV], value, square;
  const double bound = c->p.robust_gain[0] * c->p.robust_reach[0];
  int i, s;
  if (IP_GRADIENT(&c->m, c->q, &value, term) != 0) {
    return;
  }
  ip_scaled(term, -c->p.robust_gain[0] / c->scale, term, IP_NV);
  square = ip_dot(term, term, IP_NV);
  if (!isfinite(square)) {
    return;
  }
  if (square > bound * bound) {
    ip_scaled(term, bound / sqrt(square), term, IP_NV);
  }
  for (i = 0; i < IP_NV && c->least_room < c->p.robust_far[0]; ++i) {
    for (s = 0; s < 2; ++s) {
      const double distance = c->room[s][i] - c->p.robust_near[i];
      if (c->room[s][i] < c->p.robust_far[0] && (s ? term[i] < 0.0 : term[i] > 0.0)
          && distance < c->p.robust_band[i]) {
        term[i] = distance > 0.0 ? term[i] * ip_smooth(distance / c->p.robust_band[i]) : 0.0;
      }
    }
  }
  memcpy(c->term, term, sizeof term);
  c->value = value;
}

/* Advance the activation level by dt seconds. */
static void ip_activate(ip_context *c, double dt)
{
  const double step = dt / c->p.robust_ramp[0];
  if (c->x != c->goal) {
    c->x = c->goal > c->x ? fmin(c->goal, c->x + step) : fmax(c->goal, c->x - step);
    c->level = ip_smooth(c->x);
  }
  if (c->phase == IP_RELEASE && c->x == 0.0) {
    c->phase = IP_FREE;
  }
}

/* C = A B for n x n matrices. */
static void ip_multiply(const double *A, const double *B, double *C, int n)
{
  int i;
  for (i = 0; i < n; ++i) {
    ip_combine(C + i * n, n, A + i * n, 1, B, n, n);
  }
}

/* Measure lambda, the largest curvature of H along the redundancy.  Return 0 if lambda does not exist. */
static int ip_normalize(ip_context *c)
{
  enum { N = IP_NV };
  double *A = c->scratch, *V = A + N * N, *P = V + N * N, q[IP_NQ], g[2][N], value, largest;
  int all, i, j, k, redundant = 0;
  c->scale = c->p.robust_scale[0];
  if (c->scale > 0.0) {
    return 1;
  }
  /* Compute the directions that all tasks leave free.  If all tasks leave no direction free, use the directions that
   * contacts and strict levels leave free.  If contacts and strict levels leave no direction free, use all
   * directions. */
  for (all = 1; all >= 0 && !redundant; --all) {
    double most;
    memset(A, 0, sizeof(double) * N * N);
    memset(P, 0, sizeof(double) * N * N);
    for (k = 0; k < IP_FORCES + (all ? IP_ROWS : IP_STRICT); ++k) {
      const double *row = k < IP_FORCES ? ip_contact_motion(c, k) : c->J[k - IP_FORCES];
      for (i = 0; i < N; ++i) {
        ip_add(A + i * N, row[i], row, N);
      }
    }
    most = ip_eigen(A, V, N);
    for (k = 0; k < N; ++k) {
      const double *z = V + k * N;
      for (i = 0; i < N * N && !(A[k * (N + 1)] > 1e-12 * fmax(most, 1e-24)); ++i) {
        P[i] += z[i / N] * z[i % N];
        redundant = 1;
      }
    }
  }
  for (i = 0; i < N && !redundant; ++i) {
    P[i * (N + 1)] = 1.0;
  }
  /* Take finite differences along the coordinate axes of v.  Differences along a basis of the redundancy would have
   * errors that depend on the basis. */
  for (k = 0; k < N; ++k) {
    double z[N] = {0};
    z[k] = 1.0;
    for (j = 0; j < 2; ++j) {
      ip_integrate(c->q, z, j ? -1e-5 : 1e-5, q);
      if (IP_GRADIENT(&c->m, q, &value, g[j]) != 0) {
        return 0;
      }
    }
    for (i = 0; i < N; ++i) {
      A[i * N + k] = (g[0][i] - g[1][i]) / 2e-5;
    }
  }
  /* Compute the spectral norm of P A P, where P is the projection on the redundancy. */
  ip_multiply(A, P, V, N);
  memcpy(A, V, sizeof(double) * N * N);
  ip_multiply(P, A, V, N);
  for (i = 0; i < N; ++i) {
    ip_combine(P + i * N, N, V + i, N, V, N, N);
  }
  largest = sqrt(ip_eigen(P, V, N));
  if (IP_GRADIENT(&c->m, c->q, &value, g[0]) != 0) {
    return 0;
  }
  c->scale = fmax(largest, 1e-3 * fabs(value));
  return isfinite(c->scale) && c->scale > 0.0;
}
#endif

static void ip_reset_posture(ip_context *c)
{
#if IP_POSTURE
  memcpy(c->posture, c->p.posture_given[0] > 0.0 ? c->p.posture_target : c->q, sizeof c->posture);
#endif
  c->blend = 1.0;
  ip_stop_fade(c);
  c->x = c->level = c->goal = 0.0;
  c->phase = IP_FREE;
  c->waiting = 0;
  c->count = c->hold = 0;
  c->value = NAN;
  memset(c->term, 0, sizeof c->term);
#if IP_ROBUST
  {
    double gradient[IP_NV];
    if (IP_GRADIENT(&c->m, c->q, &c->value, gradient) != 0) {
      c->value = NAN;
    }
  }
#endif
}

/* Advance ramps, fades and the gradient by dt seconds. */
static void ip_advance(ip_context *c, double dt)
{
#if IP_ROBUST
  if (c->hold) {
    c->hold = 0;
    ip_fade_to(c, c->q, c->p.robust_ramp[0]);
  }
#endif
  if (c->blend < 1.0) {
    c->blend += dt / c->over;
    if (c->blend >= 1.0) {
      memcpy(c->posture, c->next, sizeof c->posture);
      c->blend = 1.0;
    }
  }
#if IP_FLOW
  ip_flow_lead(c, dt);
#endif
#if IP_ROBUST
  ip_activate(c, dt);
  if (c->level <= 0.0) {
    return;
  }
  if (c->p.robust_spring[0] == 2.0 && c->blend >= 1.0) {
    double away[IP_NV];
    ip_difference(c->posture, c->q, away);
    ip_integrate(c->posture, away, c->level * (1.0 - exp(-dt / c->p.robust_follow[0])), c->posture);
  }
  if (--c->count <= 0) {
    c->count = (int)fmin(c->p.robust_every[0], 1e9);
    ip_evaluate(c);
  }
#endif
}

/* Write the desired accelerations of the posture task; zero without a posture task. */
static void ip_posture_wanted(ip_context *c)
{
#if IP_POSTURE
  double e[IP_NV], slow[IP_NV], pull = 1.0;
  int i;
  ip_difference(c->q, c->posture, e);
  if (c->blend < 1.0) {
    const double share = ip_smooth(c->blend);
    double ahead[IP_NV];
    ip_difference(c->q, c->next, ahead);
    for (i = 0; i < IP_NV; ++i) {
      e[i] = (1.0 - share) * e[i] + share * ahead[i];
    }
  }
#if IP_ROBUST
  pull = c->p.robust_spring[0] == 1.0 ? 1.0 - c->level : 1.0;
#endif
  ip_subtract(c->posture_velocity, c->v, slow, IP_NV);
  for (i = 0; i < IP_NV; ++i) {
#if IP_STIFF
    c->wanted[i] = pull * ip_dot(c->p.stiffness + i * IP_NV, e, IP_NV) + ip_dot(c->p.damping + i * IP_NV, slow, IP_NV);
#else
    c->wanted[i] = pull * c->p.posture_kp[i] * e[i] + c->p.posture_kd[i] * slow[i];
#endif
    c->wanted[i] += c->posture_acceleration[i] + c->level * c->term[i];
  }
#else
  (void)c;
#endif
}

/* Schedule a phase, which begins with the first tick at the time t or later. */
static int ip_announce(ip_context *c, int phase, double t)
{
  const int before = c->waiting > 0 ? c->entering[c->waiting - 1] : c->phase;
  const int fits = phase == IP_BRACE ? before == IP_FREE || before == IP_RELEASE
                   : phase == IP_CONTACT ? before == IP_BRACE : before == IP_BRACE || before == IP_CONTACT;
  /* For a reference flow, phases may follow each other in any order. */
  if (!c->ready || !(IP_FLOW || (IP_ROBUST && fits)) || isnan(t) || c->waiting == IP_WAITING
      || (c->waiting > 0 && t < c->since[c->waiting - 1])) {
    return 1;
  }
  c->entering[c->waiting] = phase;
  c->since[c->waiting++] = t;
  return 0;
}

/* Begin the first waiting phase. */
static void ip_enter(ip_context *c)
{
#if IP_FLOW
  if (c->entering[0] == IP_BRACE && !ip_flow_moves(&c->flow)) {
    ip_stop_fade(c);
    if (memcmp(c->posture, c->flow.q, sizeof c->posture)) {
      ip_flow_start_at(&c->flow, c->posture);
    }
  }
  c->flow.on = c->entering[0] == IP_BRACE;
  c->level = c->flow.on;
  if (c->flow.on) {
    c->flow.deadline = c->flow.clock + c->impact[0] - ip_flow_settle(&c->p);
    c->flow.moved = 0.0;
    c->flow.remains = INFINITY;
  }
#endif
#if IP_ROBUST
  const int live = c->p.robust_live[0] > 0.0, phase = c->entering[0];
  const double was = c->goal;
  c->goal = phase == IP_BRACE || (phase == IP_CONTACT && live) ? 1.0 : 0.0;
  c->hold = phase == IP_CONTACT ? !live : phase == IP_RELEASE ? c->hold || was > 0.0 : c->hold;
#endif
  c->phase = c->entering[0];
  --c->waiting;
  memmove(c->entering, c->entering + 1, sizeof c->entering - sizeof c->entering[0]);
  memmove(c->since, c->since + 1, sizeof c->since - sizeof c->since[0]);
#if IP_FLOW
  memmove(c->impact, c->impact + 1, sizeof c->impact - sizeof c->impact[0]);
#endif
}
