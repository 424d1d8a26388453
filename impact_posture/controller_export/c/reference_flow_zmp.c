/* Bounds on the acceleration that keep the zero moment point of a standing robot in the polygon of its feet.  The
 * formulas are in impact_posture/tsid/flow/zero_moment_point.py. */

/* Set the rows and their bounds; the effect of the acceleration `known` is subtracted from the bounds. */
static void ip_flow_limit_zmp(ip_flow *f, const double *known)
{
#if IP_CONTACTS
  const double *R = f->m.base, *h = f->m.h, height = f->base[2] - f->ground;
  int i, k;
  for (k = 0; k < f->edges; ++k) {
    const double *n = f->edge[k];
    const double force[3] = {-height * n[0], -height * n[1], ip_dot(n, f->base, 2) + f->offset[k]};
    const double moment[3] = {n[1], -n[0], 0.0};
    double *row = f->zmp_row[k], wrench[6];
    memset(row, 0, sizeof f->zmp_row[k]);
    f->zmp_room[k] = INFINITY;
    if (!isfinite(f->offset[k])) {
      continue;
    }
    ip_turn(R, force, 1, wrench);
    ip_turn(R, moment, 1, wrench + 3);
    for (i = 0; i < 6; ++i) {
      ip_add(row, wrench[i], f->m.M + i * IP_NV, IP_NV);
    }
    f->zmp_room[k] = IP_ZMP_SHARE * fmax(-ip_dot(wrench, h, 6), IP_ZMP_LEAST * ip_dot(R + 6, h, 3)) - ip_dot(row, known, IP_NV);
  }
#else
  (void)f, (void)known;
#endif
}

/* Remove from the velocity change `step` within `period` seconds the parts that move the zero moment point beyond an
 * edge. */
static void ip_flow_keep_zmp(const ip_flow *f, double period, double *step)
{
  double across[IP_NV], over, square;
  int k;
  for (k = 0; k < f->edges; ++k) {
    over = ip_dot(f->zmp_row[k], step, IP_NV) - f->zmp_room[k] * period;
    if (over > 0.0) {
      memcpy(across, f->zmp_row[k], sizeof across);
      ip_flow_project(f, across);
      square = ip_dot(across, across, IP_NV);
      if (square > IP_TINY) {
        ip_add(step, -over / square, across, IP_NV);
      }
    }
  }
}
