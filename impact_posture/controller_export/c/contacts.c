/* Contacts with the ground: desired accelerations, target poses, and friction cones. */

/* Return the Jacobian row along which a component of the contact forces acts (index `entry` in the force vector). */
static const double *ip_contact_motion(const ip_context *c, int entry)
{
  const int k = ip_force_contact[entry];
  return c->m.jacobian[ip_contact_point[k]] + (entry - ip_contact_row[k]) * IP_NV;
}

/* Compute the right-hand sides of the contacts.  The rows of a contact are the Jacobian of its point. */
static void ip_contact_rows(ip_context *c)
{
  int k, i;
  for (k = 0; k < IP_CONTACTS; ++k) {
    const int point = ip_contact_point[k], row = ip_contact_row[k], size = ip_contact_row[k + 1] - row;
    double e[6], R[9], w[3];
    ip_subtract(c->home_position[k], c->m.position[point], e, 3);
    if (size == 6) {
      ip_relative(c->m.rotation[point], c->home_rotation[k], R);
      ip_log3(R, w);
      ip_turn(c->m.rotation[point], w, 0, e + 3);
    }
    for (i = 0; i < size; ++i) {
      c->contact_a[row + i] = c->p.contact_kp[k] * e[i] - c->p.contact_kd[k] * c->m.velocity[point][i]
                              - c->m.drift[point][i];
    }
  }
}

/* Return whether a sole stands on its edge: the x axis of the sole is parallel to the normal of the ground. */
static int ip_on_edge(const ip_context *c)
{
  int k;
  for (k = 0; k < IP_CONTACTS; ++k) {
    const double *R = c->m.rotation[ip_contact_point[k]], heading[3] = {R[0], R[3], R[6]};
    double across[3];
    if (ip_contact_row[k + 1] - ip_contact_row[k] == 6
        && ip_across(c->p.contact_normal + 3 * k, heading, across) < IP_ACROSS) {
      return 1;
    }
  }
  return 0;
}

/* Set the targets of the contacts to their present poses, and write the rows of the friction cones in world axes.
 * support_contact.py explains the formulas.  A row has nonzero entries only at the forces of its contact. */
static void ip_hold_contacts(ip_context *c)
{
  int k, i, j, b;
  for (k = 0; k < IP_CONTACTS; ++k) {
    const int point = ip_contact_point[k], size = ip_contact_row[k + 1] - ip_contact_row[k];
    const double *n = c->p.contact_normal + 3 * k, *R = c->m.rotation[point];
    const double mu = c->p.contact_friction[k] / sqrt(2.0), X = c->p.contact_half[2 * k], Y = c->p.contact_half[2 * k + 1];
    double heading[3] = {1.0, 0.0, 0.0}, axes[9], length, local[17][6] = {{0}};
    memcpy(c->home_position[k], c->m.position[point], sizeof c->home_position[k]);
    memcpy(c->home_rotation[k], R, sizeof c->home_rotation[k]);
    for (i = 0; size == 6 && i < 3; ++i) {
      heading[i] = R[3 * i];
    }
    for (b = 0; b < 2; ++b) {
      length = ip_across(n, heading, axes);
      if (!(length < IP_ACROSS)) {
        break;
      }
      /* The tangential axes of a point contact are arbitrary.  Start from the world axis with the smallest component
       * along the normal. */
      j = fabs(n[1]) < fabs(n[0]) ? 1 : 0;
      j = fabs(n[2]) < fabs(n[j]) ? 2 : j;
      for (i = 0; i < 3; ++i) {
        heading[i] = i == j ? 1.0 : 0.0;
      }
    }
    ip_scaled(axes, 1.0 / length, axes, 3);
    memcpy(axes + 6, n, sizeof(double) * 3);
    ip_cross(n, axes, axes + 3);
    local[0][2] = 1.0;
    for (i = 0; i < 4; ++i) {
      local[1 + i][i / 2] = i % 2 ? 1.0 : -1.0;
      local[1 + i][2] = mu;
      local[5 + i][2] = i < 2 ? Y : X;
      local[5 + i][3 + i / 2] = i % 2 ? -1.0 : 1.0;
    }
    for (i = 0; i < 8; ++i) {
      const double s = (i / 2) % 2 ? -1.0 : 1.0, t = i % 2 ? -1.0 : 1.0, sign = i < 4 ? 1.0 : -1.0;
      double *row = local[9 + i];
      row[0] = -s * Y;
      row[1] = -t * X;
      row[2] = mu * (X + Y);
      row[3] = sign * s * mu;
      row[4] = sign * t * mu;
      row[5] = sign;
    }
    for (i = 0; i < ip_contact_cone[k + 1] - ip_contact_cone[k]; ++i) {
      double *row = c->rows[IP_EQUATIONS + IP_CONTROLS + ip_contact_cone[k] + i] + IP_NV + IP_SPARE + ip_contact_row[k];
      for (b = 0; b < size; b += 3) {
        ip_turn(axes, local[i] + b, 1, row + b);
      }
    }
  }
}
