/* Courses of the reference flow.  Append this file to the source of an exported controller with the prefix "course".
 * The robot follows exactly, and no command except the first is computed. */

/* Number of values in a row of course_run, including the posture. */
enum { COURSE_ROW = 4 + COURSE_NQ };

static void course_row(const course_context *c, double *row)
{
  const course_flow *f = &c->flow;
  int i;
  row[0] = f->value;
  row[1] = row[2] = 0.0;
  for (i = 0; i < COURSE_CONTROLS; ++i) {
    row[1] = fmax(row[1], fabs(f->shares[i]));
  }
  for (i = 0; i < COURSE_HELD; ++i) {
    row[2] = fmax(row[2], fabs(f->error[i]));
  }
  row[3] = f->failures;
  memcpy(row + 4, f->here, sizeof f->here);
}

/* Start the flow at rest at q.  If `visit` is not 0, the flow visits the posture of the path first.  Write the first
 * row to out.  Return 0, or the error code of init or reset. */
int course_begin(course_context *c, const course_params *p, const double *q, int visit, double *out)
{
  static const double still[COURSE_NV] = {0};
  course_command command;
  int refused = course_init(c, p);
  refused = refused ? refused : course_reset(c, q, still, &command);
  if (!refused) {
    c->flow.visited = visit ? 0 : COURSE_PATH;
    c->flow.on = 1;
    course_row(c, out);
  }
  return refused;
}

/* Run the flow until it rests, for at most `updates` updates with ticks of dt seconds.  Write a row of out for each
 * update.  Return the number of updates. */
int course_run(course_context *c, double dt, int updates, double *out)
{
  int k, i;
  for (k = 0; k < updates; ++k) {
    for (i = 0; i < COURSE_FLOW_PHASES; ++i) {
      memcpy(c->q, c->flow.q, sizeof c->q);
      course_flow_lead(c, dt);
    }
    course_row(c, out + k * COURSE_ROW);
    if (c->flow.resting && !(course_largest(c->flow.velocity, 0) > 1e-4)) {
      return k + 1;
    }
  }
  return updates;
}
