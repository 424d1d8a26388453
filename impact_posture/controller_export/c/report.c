/* Diagnosis of a tick. */

void ip_last_report(const ip_context *c, ip_report *report)
{
  int r, i, j;
  memset(report, 0, sizeof *report);
  report->status = c->status;
  report->level = c->level;
  report->value = c->value;
  memcpy(report->target, c->posture, sizeof report->target);
#if IP_FLOW
  report->flow_failures = c->flow.failures;
  report->resting = c->flow.resting;
#endif
  report->dynamics = NAN;
  report->iterations = c->iterations;
  if (c->held_now) {
    return;
  }
  memcpy(report->relaxed, c->gave, sizeof report->relaxed);
  memcpy(report->deficient, c->missed, sizeof report->deficient);
  memcpy(report->multipliers, c->multipliers, sizeof report->multipliers);
  for (r = 0; r < IP_ROWS; ++r) {
    report->rows[r] = ip_dot(c->J[r], c->z, IP_NV) - c->a[r];
  }
  report->dynamics = 0.0;
  for (i = 0; i < IP_NV; ++i) {
    double error = ip_dot(c->m.M + i * IP_NV, c->z, IP_NV) + c->free_force[i];
    report->posture[i] = c->z[i] - c->wanted[i];
    for (j = 0; j < IP_FORCES; ++j) {
      error -= ip_contact_motion(c, j)[i] * c->z[IP_NV + IP_SPARE + j];
    }
    for (j = 0; j < IP_ROTORS && i < IP_BASE; ++j) {
      error -= ip_allocation[i * IP_ROTORS + j] * c->held[j];
    }
    error -= i < IP_BASE ? 0.0 : c->held[IP_ROTORS + i - IP_BASE];
    report->dynamics = fmax(report->dynamics, fabs(error));
  }
  for (j = 0; j < IP_FORCES; ++j) {
    report->contacts[j] = ip_dot(ip_contact_motion(c, j), c->z, IP_NV) - c->contact_a[j];
  }
}
