/* Redundancy of the reference flow, and the static controls that hold its posture.  The formulas are in
 * impact_posture/tsid/flow/redundancy.py and static_controls.py. */

#if IP_BASE
/* Solve R'R x = b in place, R upper triangular in n x n. */
static void ip_solve_factor(const double *R, int n, double *b)
{
  int i, j;
  for (i = 0; i < n; ++i) {
    b[i] /= R[i * (n + 1)];
    for (j = i + 1; j < n; ++j) {
      b[j] -= R[i * n + j] * b[i];
    }
  }
  for (i = n - 1; i >= 0; --i) {
    for (j = i + 1; j < n; ++j) {
      b[i] -= R[i * n + j] * b[j];
    }
    b[i] /= R[i * (n + 1)];
  }
}
#endif

/* Write eigenvectors and eigenvalues of JJ' into f->work.  The squares of singular values above 2 % of the largest
 * are exact enough. */
static void ip_flow_decompose(ip_context *c)
{
  enum { N = IP_NV, M = IP_HELD };
  ip_flow *f = &c->flow;
  double *G = f->work;
  int i, j;
  for (i = 0; i < M; ++i) {
    for (j = 0; j <= i; ++j) {
      G[i * M + j] = G[j * M + i] = ip_dot(f->J[i], f->J[j], N);
    }
  }
  f->most = ip_eigen(G, G + M * M, M);
}

/* Compute the pseudo-inverse of J on the constrained directions, and an orthonormal basis of the null space of J in
 * the rows of Z, from the eigenvectors of JJ'. */
static void ip_flow_space(ip_flow *f)
{
  enum { N = IP_NV, M = IP_HELD };
  double *G = f->work, *U = G + M * M, *held = U + M * M, *T = held + M * N, beta, w[IP_LARGEST];
  int i, k, rank = 0;
  for (k = 0; k < M && rank < N; ++k) {
    const double value = G[k * (M + 1)];
    if (value > IP_SLACK * IP_SLACK * f->most) {
      ip_scaled(U + k * M, 1.0 / sqrt(value), U + rank * M, M);
      ip_combine(held + rank * N, N, U + rank * M, 1, f->J[0], N, M);
      ++rank;
    }
  }
  for (i = 0; i < N; ++i) {
    ip_combine(f->inverse + i * M, M, held + i, N, U, M, rank);
  }
  /* Compute reflections that map the constrained directions to the first unit vectors.  The same reflections map Z to
   * the other unit vectors.  The product of the reflections is I - V'RV, where the rows of V are the vectors of the
   * reflections and R is upper triangular (Golub and Van Loan, section 5.1.7).  T is R'. */
  for (k = 0; k < rank; ++k) {
    double *v = held + k * N, size = sqrt(ip_dot(v + k, v + k, N - k));
    v[k] += v[k] < 0.0 ? -size : size;
    beta = 1.0 / (size * fabs(v[k]));
    memset(v, 0, sizeof(double) * (size_t)k);
    for (i = k + 1; i < rank; ++i) {
      double *row = held + i * N + k;
      ip_add(row, -beta * ip_dot(v + k, row, N - k), v + k, N - k);
    }
    for (i = 0; i < k; ++i) {
      w[i] = -beta * ip_dot(held + i * N + k, v + k, N - k);
    }
    memset(T + k * M, 0, sizeof(double) * M);
    for (i = 0; i < k; ++i) {
      ip_add(T + k * M, w[i], T + i * M, k);
    }
    T[k * (M + 1)] = beta;
  }
  f->left = N - rank;
  f->soft = rank < (M < N ? M : N);
  for (i = 0; i < f->left; ++i) {
    ip_combine(w, rank, held + rank + i, N, T, M, rank);
    ip_combine(f->Z[i], N, w, 1, held, N, rank);
    ip_scaled(f->Z[i], -1.0, f->Z[i], N);
    f->Z[i][rank + i] += 1.0;
  }
  for (i = 0; f->soft && i < M; ++i) {
    for (k = 0; k < f->left; ++k) {
      f->spring[i][k] = ip_dot(f->J[i], f->Z[k], N);
    }
  }
}

/* Factorize the product of the joint part of Z with itself, for ip_flow_moving. */
static void ip_flow_still(ip_flow *f)
{
#if IP_BASE
  double *square = f->joints;
  const int n = f->left;
  int i, k;
  for (k = 0; k < n; ++k) {
    for (i = 0; i <= k; ++i) {
      square[i * n + k] = ip_dot(f->Z[i] + IP_BASE, f->Z[k] + IP_BASE, IP_JOINTS_V) + (i == k ? IP_IDLE : 0.0);
    }
  }
  f->stills = n && ip_cholesky(square, n);
#else
  (void)f;
#endif
}

/* x = Z Z' x. */
static void ip_flow_project(const ip_flow *f, double *x)
{
  double out[IP_NV] = {0};
  int k;
  for (k = 0; k < f->left; ++k) {
    ip_add(out, ip_dot(f->Z[k], x, IP_NV), f->Z[k], IP_NV);
  }
  memcpy(x, out, sizeof out);
}

/* Compute the contact forces with the least weighted norm that carry a wrench on the base.  Write the generalized
 * force J' f that these forces f cause, for a unit of each entry of the wrench. */
static void ip_flow_carry(ip_flow *f)
{
#if IP_CONTACTS
  double square[36] = {0}, trace = 0.0, s[6], ease[IP_FORCES];
  int i, k;
  for (k = 0; k < IP_FORCES; ++k) {
    ease[k] = k - ip_contact_row[ip_force_contact[k]] < 3 ? 1.0 : 1.0 / IP_MOMENT;
    for (i = 0; i < 6; ++i) {
      ip_add(square + 6 * i, ease[k] * f->J[k][i], f->J[k], 6);
    }
  }
  for (i = 0; i < 6; ++i) {
    trace += square[7 * i];
  }
  for (i = 0; i < 6; ++i) {
    /* Feet on one line cannot carry a moment about this line, so the matrix would be singular. */
    square[7 * i] += IP_TINY * trace;
  }
  memset(f->carried, 0, sizeof f->carried);
  if (!ip_cholesky(square, 6)) {
    f->failed = 1;
    return;
  }
  for (k = 0; k < IP_FORCES; ++k) {
    ip_scaled(f->J[k], ease[k], s, 6);
    ip_solve_factor(square, 6, s);
    for (i = 0; i < IP_NV; ++i) {
      ip_add(f->carried[i], f->J[k][i], s, 6);
    }
  }
#else
  (void)f;
#endif
}

/* Return half of the control range that static controls may use; return 0 if the control has no limits. */
static double ip_flow_half(const ip_params *p, int i)
{
  const double half = p->flow_share[0] * (p->control_upper[i] - p->control_lower[i]) / 2.0;
  return isfinite(half) ? half : 0.0;
}

/* Compute the controls that produce a generalized force, divided by half of their permitted ranges (ip_flow_half). */
static void ip_flow_needed(const ip_context *c, const double *force, double *shares)
{
  double rest[IP_NV];
  int i;
  for (i = 0; i < IP_NV; ++i) {
    rest[i] = force[i] - (IP_CONTACTS ? ip_dot(c->flow.carried[i], force, 6) : 0.0);
  }
  for (i = 0; i < IP_CONTROLS; ++i) {
    const double half = ip_flow_half(&c->p, i);
    const double s = i < IP_ROTORS ? ip_dot(ip_inverse + i * IP_BASE, rest, IP_BASE) : rest[IP_BASE + i - IP_ROTORS];
    shares[i] = half > 0.0 ? s / half : 0.0;
  }
}

/* Compute the static controls at the posture of the flow, measured from the middle of their ranges. */
static void ip_flow_shares(ip_context *c, double *shares)
{
  int i;
  ip_flow_carry(&c->flow);
  ip_flow_needed(c, c->flow.m.h, shares);
  for (i = 0; i < IP_CONTROLS; ++i) {
    const double half = ip_flow_half(&c->p, i);
    shares[i] -= half > 0.0 ? (c->p.control_upper[i] + c->p.control_lower[i]) / 2.0 / half : 0.0;
  }
}

/* Return the share of the acceleration `more`, 0 to 1, that the actuators permit.  `known` and `more` together may
 * use the share `haste` of the range that the static controls do not use. */
static double ip_flow_permitted(const ip_context *c, const double *known, const double *more, double haste)
{
  const ip_flow *f = &c->flow;
  double force[2][IP_NV], taken[IP_CONTROLS], added[IP_CONTROLS], part = 1.0;
  int i;
  for (i = 0; i < IP_NV; ++i) {
    force[0][i] = ip_dot(f->m.M + i * IP_NV, known, IP_NV);
    force[1][i] = ip_dot(f->m.M + i * IP_NV, more, IP_NV);
  }
  ip_flow_needed(c, force[0], taken);
  ip_flow_needed(c, force[1], added);
  for (i = 0; i < IP_CONTROLS; ++i) {
    const double side = added[i] < 0.0 ? -1.0 : 1.0;
    const double room = fmax(1.0 / c->p.flow_share[0] - side * f->shares[i], IP_LEFT / c->p.flow_share[0]);
    if (added[i] != 0.0) {
      part = fmin(part, (haste * room - side * taken[i]) / fmax(fabs(added[i]), IP_TINY));
    }
  }
  return fmax(part, 0.0);
}

#if IP_CONTACTS
/* Compute outward normals n and offsets b of the polygon n c + b <= 0 of the feet on level ground, as in
 * support_edges.  If the feet do not span an area, the center of mass must not move, and the result is four edges
 * with infinite b. */
static void ip_flow_polygon(ip_context *c)
{
  enum { COUNT = 4 * IP_CONTACTS };
  ip_flow *f = &c->flow;
  double x[COUNT][2], mean[4][2] = {{0.0}};
  int i, j, start = 0, at, next, edges = 0;
  double even = IP_EVEN;
  f->ground = c->m.position[ip_contact_point[0]][2];
  for (i = 0; i < COUNT; ++i) {
    const double *R = c->m.rotation[ip_contact_point[i / 4]], *half = c->p.contact_half + 2 * (i / 4);
    const int sole = ip_contact_row[i / 4 + 1] - ip_contact_row[i / 4] == 6;
    for (j = 0; j < 2; ++j) {
      x[i][j] = c->m.position[ip_contact_point[i / 4]][j];
      /* A point contact has no corners, and the model does not compute the rotation of its frame. */
      x[i][j] += sole ? (i & 1 ? 1.0 : -1.0) * half[0] * R[3 * j] + (i & 2 ? 1.0 : -1.0) * half[1] * R[3 * j + 1] : 0.0;
    }
    ip_add(mean[i % 4], 1.0 / IP_CONTACTS, x[i], 2);
    even = sole ? even : 0.0;
  }
  for (i = 0; i < COUNT; ++i) {
    for (j = 0; j < 2; ++j) {
      x[i][j] += even * (mean[i % 4][j] - x[i][j]);
    }
    /* Start at the leftmost corner.  If several corners are leftmost, start at the lowest leftmost corner, which is
     * the end of an edge. */
    start = x[i][0] < x[start][0] - IP_ON_LINE || (x[i][0] <= x[start][0] + IP_ON_LINE && x[i][1] < x[start][1]) ? i
                                                                                                                : start;
  }
  for (at = start; edges < IP_EDGES; at = next) {
    double edge[2] = {0.0, 0.0}, length = 0.0;
    for (i = 0, next = at; i < COUNT; ++i) {
      const double step[2] = {x[i][0] - x[at][0], x[i][1] - x[at][1]}, far = hypot(step[0], step[1]);
      const double turn = edge[0] * step[1] - edge[1] * step[0];
      const double near = IP_ON_LINE * length;
      if (far > IP_ON_LINE && (next == at || turn < -near || (turn <= near && far > length))) {
        next = i;
        length = far;
        memcpy(edge, step, sizeof edge);
      }
    }
    if (next == at) {
      break;
    }
    f->edge[edges][0] = edge[1] / length;
    f->edge[edges][1] = -edge[0] / length;
    f->offset[edges] = -ip_dot(f->edge[edges], x[at], 2);
    ++edges;
    if (hypot(x[next][0] - x[start][0], x[next][1] - x[start][1]) <= IP_ON_LINE) {
      break;
    }
  }
  for (i = 0; edges < 3 && i < 4; ++i) {
    f->edge[i][0] = i % 2 ? 0.0 : i < 2 ? 1.0 : -1.0;
    f->edge[i][1] = i % 2 ? (i < 2 ? 1.0 : -1.0) : 0.0;
    f->offset[i] = INFINITY;
  }
  f->edges = edges < 3 ? 4 : edges;
}
#endif
