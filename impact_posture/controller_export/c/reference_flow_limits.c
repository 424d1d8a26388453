/* Limits of the reference flow: distances from the limits, and changes of the flow that do not cross them.  The
 * formulas are in impact_posture/tsid/flow/flow_direction.py. */

/* Return the largest absolute value from the entry `first` on. */
static double ip_largest(const double *x, int first)
{
  double most = 0.0;
  int i;
  for (i = first; i < IP_NV; ++i) {
    most = fmax(most, fabs(x[i]));
  }
  return most;
}

/* Return the change of a limited quantity (row r) that a displacement causes.  A rotation of the base across the tilt
 * axis increases the tilt only to second order. */
static double ip_flow_ahead(const ip_flow *f, int r, const double *moved)
{
  const double along = r < IP_JOINTS_V               ? moved[IP_BASE + r]
                       : r < IP_JOINTS_V + IP_PLACED ? ip_dot(f->row[r - IP_JOINTS_V], moved, IP_NV)
                                                     : ip_dot(f->T[r - IP_JOINTS_V - IP_PLACED], moved, IP_NV);
#if IP_BASE
  if (r == IP_JOINTS_V + IP_EDGES) {
    const double turn = ip_dot(f->vertical, moved + 3, 3);
    const double aside = ip_dot(moved + 3, moved + 3, 3) - turn * turn - along * along;
    return hypot(f->tilt + along, sqrt(fmax(aside, 0.0))) - f->tilt;
  }
#endif
  return along;
}

/* Compute the limits on the step at the posture of the flow, tightened by the braking distance of the flow. */
static void ip_flow_limits(ip_context *c)
{
  ip_flow *f = &c->flow;
  const ip_params *p = &c->p;
  double position[3], J[3 * IP_NV], drift[3], coasting[IP_NV];
  int j, k, r;
  ip_scaled(f->flow, p->flow_speed[0] / p->flow_acceleration[0] / 2.0, coasting, IP_NV);
  ip_center_of_mass(&f->m, f->here, position, J, drift);
  for (r = 0; r < IP_FLOW_ROWS; ++r) {
    double high = INFINITY, low = -INFINITY, ahead = 0.0, aim;
    if (r < IP_JOINTS_V) {
      const double upper = p->joint_upper[IP_BASE + r], lower = p->joint_lower[IP_BASE + r];
      const double at = f->here[ip_limit_q[IP_BASE + r]], margin = fmin(p->flow_joint_margin[0], (upper - lower) / 8.0);
      ahead = coasting[IP_BASE + r];
      if (isfinite(upper) && isfinite(lower)) {
        high = upper - at - margin;
        low = -(at - lower - margin);
      }
    } else if (r < IP_JOINTS_V + IP_EDGES) {
      k = r - IP_JOINTS_V;
      memset(f->row[k], 0, sizeof f->row[k]);
      if (k < f->edges) {
        for (j = 0; j < IP_NV; ++j) {
          f->row[k][j] = f->edge[k][0] * J[j] + f->edge[k][1] * J[IP_NV + j];
        }
        high = -f->offset[k] - p->flow_com_margin[0] - ip_dot(f->edge[k], position, 2);
        ahead = ip_dot(f->row[k], coasting, IP_NV);
      }
#if IP_BASE
    } else if (r < IP_JOINTS_V + IP_PLACED) {
      double axis[3], sine;
      memcpy(f->vertical, f->m.base + 6, sizeof f->vertical);
      ip_cross(f->vertical, ip_upright, axis);
      sine = sqrt(ip_dot(axis, axis, 3));
      for (j = 0; j < 3; ++j) {
        f->row[IP_EDGES][3 + j] = sine > IP_LEVEL ? axis[j] / sine : 0.0;
      }
      f->tilt = atan2(sine, ip_dot(f->vertical, ip_upright, 3));
      high = p->flow_tilt[0] - f->tilt;
      ahead = ip_dot(f->row[IP_EDGES], coasting, IP_NV);
#endif
    } else {
      k = r - IP_JOINTS_V - IP_PLACED;
      if (ip_flow_half(p, k) > 0.0) {
        high = 1.0 - f->shares[k];
        low = -1.0 - f->shares[k];
        ahead = ip_dot(f->T[k], coasting, IP_NV);
      }
    }
    aim = r < IP_JOINTS_V ? IP_AIM : r < IP_JOINTS_V + IP_PLACED ? 0.0 : IP_RESERVE;
    high -= aim;
    low += aim;
    f->room[0][r] = fmax(high, -IP_SPENT);
    f->room[1][r] = fmin(low, IP_SPENT);
    f->high[r] = fmax(high - fmax(ahead, 0.0), 0.0);
    f->low[r] = fmin(low - fmin(ahead, 0.0), 0.0);
  }
}

/* Compute the displacement within `time` seconds if the velocity of the flow changes by `step`. */
static void ip_flow_after(const ip_flow *f, const double *step, double time, double *moved)
{
  int i;
  for (i = 0; i < IP_NV; ++i) {
    moved[i] = time * (f->flow[i] + step[i]);
  }
}

/* Remove from the velocity change `step`, limit by limit, the parts that cross limits within `time` seconds. */
static void ip_flow_along_limits(const ip_flow *f, double time, double *step)
{
  double moved[IP_NV], across[IP_NV], over, square;
  int r;
  ip_flow_after(f, step, time, moved);
  for (r = 0; r < IP_FLOW_ROWS; ++r) {
    const int k = r - IP_JOINTS_V;
    over = ip_flow_ahead(f, r, moved);
    over -= fmin(fmax(over, f->room[1][r]), f->room[0][r]);
    if (over == 0.0) {
      continue;
    }
    memset(across, 0, sizeof across);
    if (k < 0) {
      across[IP_BASE + r] = 1.0;
    } else {
      memcpy(across, k < IP_PLACED ? f->row[k] : f->T[k - IP_PLACED], sizeof across);
    }
    ip_flow_project(f, across);
    square = ip_dot(across, across, IP_NV);
    if (square > IP_FLAT) {
      ip_add(step, -over / time / square, across, IP_NV);
      ip_add(moved, -over / square, across, IP_NV);
    }
  }
}
