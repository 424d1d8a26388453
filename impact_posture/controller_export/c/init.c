/* Check the parameters and initialize the context. */

const unsigned long ip_context_bytes = (unsigned long)sizeof(ip_context);

/* Return whether a number satisfies the rule (a value of ip_rules) and is not NaN. */
static int ip_holds(int rule, double x)
{
  return !isnan(x) && (!(rule & IP_IS_FINITE) || isfinite(x)) && (!(rule & IP_NOT_NEGATIVE) || x >= 0.0)
         && (!(rule & IP_NOT_ZERO) || x != 0.0) && (!(rule & IP_AT_MOST_ONE) || x <= 1.0);
}

int ip_init(ip_context *c, const ip_params *p)
{
  const double *value = (const double *)p;
  int k, i;
  for (k = 0; k < IP_PARAMETERS; ++k) {
    for (i = 0; i < ip_rules[2 * k]; ++i) {
      if (!ip_holds(ip_rules[2 * k + 1], *value++)) {
        return k + 1;
      }
    }
  }
  for (i = 0; i < IP_CONTROLS; ++i) {
    if (!(p->control_lower[i] <= p->control_upper[i]) || p->control_lower[i] == INFINITY || p->control_upper[i] == -INFINITY) {
      return IP_AT_CONTROL_UPPER;
    }
  }
  for (i = IP_BASE; i < IP_NV; ++i) {
    if (!(p->joint_lower[i] <= p->joint_upper[i])) {
      return IP_AT_JOINT_UPPER;
    }
  }
  for (k = 0; k < IP_CONTACTS; ++k) {
    if (!(fabs(sqrt(ip_dot(p->contact_normal + 3 * k, p->contact_normal + 3 * k, 3)) - 1.0) < 1e-9)) {
      return IP_AT_CONTACT_NORMAL;
    }
  }
  for (i = 0; IP_MOMENTUM && i < 3; ++i) {
    /* With IP_MOMENTUM (qp.c), the posture task must have no weight on the base. */
    if (p->posture_weight[i] != 0.0) {
      return IP_AT_POSTURE_WEIGHT;
    }
  }
  for (i = 0; IP_MOMENTUM && i < IP_ROWS; ++i) {
    if (!(p->task_weight[i] > 0.0)) {
      return IP_AT_TASK_WEIGHT;
    }
  }
  if (!(p->law_rate[0] >= 4.0 * p->law_approach[0])) {
    return IP_AT_LAW_RATE;
  }
  if (relaxation_bytes(IP_VARIABLES, IP_OTHERS, 1 + IP_LEVELS) > sizeof c->relaxation) {
    return -1;
  }
  memset(c, 0, sizeof *c);
  c->p = *p;
  c->excess = 1.0;
  for (i = 0; i < IP_CONTROLS; ++i) {
    c->excess = isfinite(p->control_lower[i]) ? fmax(c->excess, fabs(p->control_lower[i])) : c->excess;
    c->excess = isfinite(p->control_upper[i]) ? fmax(c->excess, fabs(p->control_upper[i])) : c->excess;
  }
  c->excess *= 1e-6;
  IP_CONSTANTS(c, &c->m);
  IP_CONSTANTS(c, &c->ahead);
  return 0;
}
