/* Ticks of a simulated world with a controller in C.  The results are the same as with the class World in world.py,
 * with the sensors of sensor_noise.py, the propellers of rotors.py and the contacts of contact_forces.py.  These Python
 * files explain the terms.  compiled_world.py defines ROTORS and TARGET. */
#include <math.h>
#include <string.h>

#include <mujoco/mujoco.h>

#define PI 3.14159265358979323846
/* If the square of an angle is below this value, power series replace sine and cosine. */
#define SMALL 1e-8

/* compiled_world.py reads the names and types of the members from this text, and sets the members. */
typedef struct {
  const mjModel *model;
  mjData *data;
  void (*step1)(const mjModel *, mjData *);
  void (*step2)(const mjModel *, mjData *);
  void (*apply)(const mjModel *, mjData *, const double *, const double *, const double *, int, double *);
  int (*tick)(void *, double, const double *, const double *, const double *, void *);

  /* The controller: its inputs, its outputs, and its targets. */
  void *context, *command;
  double *q, *v, *force, *u, *rotor_speed, *level, *target;
  int *status, targets;

  /* The robot: indices of q and v in qpos and qvel, and the true state. */
  int nq, nv, nqpos, floating, joints, *q_at, *v_at;
  double *true_q, *true_v, *effort, *torque, runaway;
  /* 1 if the last command was invalid.  The check is the same as in CommandLimits.within. */
  int refused;

  /* Time: number of physics steps since the reset, number of physics steps in a tick, and time step in s. */
  int steps, count;
  double timestep;

  /* The propellers: speeds and angles, relative changes of a speed after each step of a tick, limits, vibration. */
  int rotors, vibrates;
  double *speeds, *phases, *up, *down, lowest, highest, thrust, *along, *across, *inverse;

  /* The sensors: flags for the readings with noise, and the low-pass filter of the force on a shape. */
  int noises, noisy_q, noisy_v, noisy_force, felt;
  double resolution, share, *filtered;

  /* The shapes: the shape of each geom, forces in the last step, and quantities accumulated over steps. */
  int shapes, *shape_of;
  double *now, *normal, *impulse, *peak, *began;

  /* Pushes: bodies, last steps, and for each push the point (coordinates of its body) and the force. */
  int pushes, *push_body, *push_end;
  double *push;

  /* For each tick: flags of the targets that Python changes, the changed targets, and the noise. */
  int *led;
  double *lead, *noise;

  /* Recorded results, one row per tick. */
  int *row_status;
  double *row_t, *row_q, *row_v, *row_qpos, *row_rotor_speeds, *row_torques, *row_command, *row_level;
  double *row_touching, *row_force, *row_impulse, *row_peak, *row_began, *row_slip;
} world;

static double dot(const double *a, const double *b, int n)
{
  double sum = 0.0;
  int k;
  for (k = 0; k < n; ++k) {
    sum += a[k] * b[k];
  }
  return sum;
}

static void cross(const double *a, const double *b, double *out)
{
  int k;
  for (k = 0; k < 3; ++k) {
    out[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
  }
}

/* Rotation matrix R of a unit quaternion x y z w, stored row by row. */
static void rotation(const double *x, double *R)
{
  int i, j;
  for (i = 0; i < 3; ++i) {
    const int a = (i + 1) % 3, b = (i + 2) % 3;
    for (j = 0; j < 3; ++j) {
      R[3 * i + j] = 2.0 * x[i] * x[j];
    }
    R[4 * i] = 1.0 - 2.0 * (x[a] * x[a] + x[b] * x[b]);
    R[3 * i + a] -= 2.0 * x[b] * x[3];
    R[3 * i + b] += 2.0 * x[a] * x[3];
  }
}

/* Compute the state in the coordinates of Pinocchio. */
static void state(const world *w, double *q, double *v)
{
  const double *qvel = w->data->qvel;
  double R[9], length;
  int i, k;
  for (k = 0; k < w->nq; ++k) {
    q[k] = w->data->qpos[w->q_at[k]];
  }
  for (k = 0; k < w->nv; ++k) {
    v[k] = qvel[w->v_at[k]];
  }
  if (w->floating) {
    length = sqrt(dot(q + 3, q + 3, 4));
    for (k = 3; k < 7; ++k) {
      q[k] /= length;
    }
    rotation(q + 3, R);
    for (i = 0; i < 3; ++i) {
      v[i] = 0.0;
      for (k = 0; k < 3; ++k) {
        v[i] += R[3 * k + i] * qvel[w->v_at[k]];
      }
    }
  }
}

/* Move the pose of a base (xyz and quaternion) by the twist d, in base axes, for one second. */
static void move_base(double *q, const double *d)
{
  const double *p = d, *r = d + 3;
  const double square = dot(r, r, 3), t = sqrt(square), small = square < SMALL;
  const double sine = small ? 1.0 - square / 6.0 : sin(t) / t;
  const double one_minus_cosine = small ? 0.5 - square / 24.0 : (1.0 - cos(t)) / square;
  const double along = (small ? 1.0 / 6.0 - square / 120.0 : (1.0 - sine) / square) * dot(r, p, 3);
  const double half = small ? 0.5 - square / 48.0 : sin(0.5 * t) / t, w = cos(0.5 * t);
  const double turn[3] = {half * r[0], half * r[1], half * r[2]}, *x = q + 3;
  double R[9], side[3], moved[3], found[4], length;
  int i, k;
  cross(r, p, side);
  for (i = 0; i < 3; ++i) {
    moved[i] = sine * p[i] + along * r[i] + one_minus_cosine * side[i];
  }
  rotation(x, R);
  for (i = 0; i < 3; ++i) {
    q[i] += dot(R + 3 * i, moved, 3);
  }
  cross(x, turn, side);
  for (i = 0; i < 3; ++i) {
    found[i] = x[3] * turn[i] + w * x[i] + side[i];
  }
  found[3] = x[3] * w - dot(x, turn, 3);
  length = sqrt(dot(found, found, 4));
  for (k = 0; k < 4; ++k) {
    q[3 + k] = found[k] / length;
  }
}

/* Add the vibration of unbalanced propellers to the measured twist of the base. */
static void vibrate(const world *w, double *v)
{
  double force[6] = {0}, rate;
  int i, k;
  for (k = 0; k < w->rotors; ++k) {
    rate = 2.0 * PI * w->speeds[k];
    for (i = 0; i < 6; ++i) {
      const double *x = w->along + i * w->rotors, *y = w->across + i * w->rotors;
      force[i] += rate * (x[k] * sin(w->phases[k]) + y[k] * cos(w->phases[k]));
    }
  }
  for (i = 0; i < 6; ++i) {
    v[i] += dot(w->inverse + 6 * i, force, 6);
  }
}

/* Compute the sensor readings from the true state and the noise of this reading. */
static void measure(const world *w, const double *noise)
{
  double *q = w->q, *v = w->v;
  int k;
  memcpy(q, w->true_q, sizeof(double) * w->nq);
  memcpy(v, w->true_v, sizeof(double) * w->nv);
  if (w->vibrates) {
    vibrate(w, v);
  }
  if (w->noisy_q) {
    if (w->floating) {
      move_base(q, noise);
    }
    /* Each joint has one value.  A base has 7 values in q and 6 in v, so joint k of v has the index k + 1 in q. */
    for (k = 6 * w->floating; k < w->nv; ++k) {
      q[k + w->floating] += noise[k];
    }
    noise += w->nv;
  }
  for (k = 7 * w->floating; k < w->nq && w->resolution > 0.0; ++k) {
    q[k] = rint(q[k] / w->resolution) * w->resolution;
  }
  if (w->noisy_v) {
    for (k = 0; k < w->nv; ++k) {
      v[k] += noise[k];
    }
    noise += w->nv;
  }
  for (k = 0; k < 3 && w->felt >= 0; ++k) {
    w->force[k] = w->filtered[k] + (w->noisy_force ? noise[k] : 0.0);
  }
}

static void push(const world *w)
{
  const double none[3] = {0};
  double place[3];
  int i, k;
  if (!w->pushes) {
    return;
  }
  memset(w->data->qfrc_applied, 0, sizeof(double) * w->model->nv);
  for (k = 0; k < w->pushes; ++k) {
    const double *own = w->push + 6 * k;
    const int body = w->push_body[k];
    if (w->push_end[k] > w->steps) {
      for (i = 0; i < 3; ++i) {
        place[i] = w->data->xpos[3 * body + i] + dot(w->data->xmat + 9 * body + 3 * i, own, 3);
      }
      w->apply(w->model, w->data, own + 3, none, place, body, w->data->qfrc_applied);
    }
  }
}

/* Compute the forces of the surfaces on the shapes in the last step, and update the accumulated quantities. */
static void contacts(const world *w)
{
  const double step = w->timestep, began = w->data->time - step;
  int c, i, k;
  memset(w->now, 0, sizeof(double) * 3 * w->shapes);
  memset(w->normal, 0, sizeof(double) * w->shapes);
  for (c = 0; c < w->data->ncon; ++c) {
    const mjContact *at = w->data->contact + c;
    const int one = w->shape_of[at->geom[0]], other = w->shape_of[at->geom[1]], shape = one > other ? one : other;
    if (at->efc_address >= 0 && shape >= 0) {
      const double *force = w->data->efc_force + at->efc_address;
      for (k = 0; k < (at->dim == 3 ? 3 : 1); ++k) {
        for (i = 0; i < 3; ++i) {
          w->now[3 * shape + i] += (other >= 0 ? 1.0 : -1.0) * force[k] * at->frame[3 * k + i];
        }
      }
      w->normal[shape] += force[0];
    }
  }
  for (k = 0; k < w->shapes; ++k) {
    for (i = 0; i < 3; ++i) {
      w->impulse[3 * k + i] += step * w->now[3 * k + i];
    }
    w->peak[k] = fmax(w->peak[k], w->normal[k]);
    if (w->normal[k] > 0.0) {
      w->began[k] = fmin(w->began[k], began);
    }
  }
  for (i = 0; i < 3 && w->felt >= 0; ++i) {
    w->filtered[i] += w->share * (w->now[3 * w->felt + i] - w->filtered[i]);
  }
}

/* Compute, for each shape that a surface pushes, the largest tangential speed of the contact points. */
static void slips(const world *w, double *slip)
{
  double arm[3], velocity[3], normal;
  int c, i;
  memset(slip, 0, sizeof(double) * w->shapes);
  for (c = 0; c < w->data->ncon; ++c) {
    const mjContact *at = w->data->contact + c;
    const int body = w->model->geom_bodyid[at->geom[1]], shape = w->shape_of[at->geom[1]];
    const double *twist = w->data->cvel + 6 * body, *center = w->data->subtree_com + 3 * w->model->body_rootid[body];
    if (w->model->geom_bodyid[at->geom[0]] || shape < 0 || !(w->normal[shape] > 0.0)) {
      continue;
    }
    for (i = 0; i < 3; ++i) {
      arm[i] = at->pos[i] - center[i];
    }
    cross(twist, arm, velocity);
    for (i = 0; i < 3; ++i) {
      velocity[i] += twist[3 + i];
    }
    normal = dot(at->frame, velocity, 3);
    for (i = 0; i < 3; ++i) {
      velocity[i] -= normal * at->frame[i];
    }
    slip[shape] = fmax(slip[shape], sqrt(dot(velocity, velocity, 3)));
  }
}

/* Take the physics steps of a tick with the present command. */
static void advance(world *w)
{
  double *control = w->data->ctrl, away[ROTORS], begin[ROTORS], angle[ROTORS], whole[ROTORS] = {0};
  int k, step;
  for (k = 0; k < w->rotors; ++k) {
    away[k] = fmin(fmax(w->rotor_speed[k], w->lowest), w->highest) - w->speeds[k];
    begin[k] = w->speeds[k];
    angle[k] = w->phases[k];
  }
  for (k = 0; k < w->joints; ++k) {
    w->torque[k] = fmin(fmax(w->u[w->rotors + k], -w->effort[k]), w->effort[k]);
    control[w->rotors + k] = w->torque[k];
  }
  for (step = 0; step < w->count; ++step) {
    for (k = 0; k < w->rotors; ++k) {
      const double speed = begin[k] - (away[k] > 0.0 ? w->up : w->down)[step] * away[k];
      whole[k] += speed;
      w->speeds[k] = speed;
      w->phases[k] = angle[k] + 2.0 * PI * w->timestep * whole[k];
      control[k] = w->thrust * (speed * speed);
    }
    push(w);
    w->step2(w->model, w->data);
    ++w->steps;
    contacts(w);
    w->step1(w->model, w->data);
  }
}

/* Return 1 if the command is not finite, or if a torque after clipping to the effort limits is too large. */
static int refuses(const world *w)
{
  int k;
  if (dot(w->u, w->u, w->rotors + w->joints) + dot(w->rotor_speed, w->rotor_speed, w->rotors) < w->runaway) {
    return 0;
  }
  for (k = 0; k < w->rotors; ++k) {
    if (!isfinite(w->rotor_speed[k])) {
      return 1;
    }
  }
  for (k = 0; k < w->joints; ++k) {
    const double u = w->u[w->rotors + k], torque = fmin(fabs(u), w->effort[k]);
    if (!isfinite(u) || !(torque * torque < w->runaway)) {
      return 1;
    }
  }
  return 0;
}

/* Run at most `ticks` ticks.  Return the number of ticks before the state diverged or a command was invalid. */
int world_ticks(world *w, int ticks)
{
  const int targets = w->targets;
  int tick, k;
  for (tick = 0; tick < ticks; ++tick) {
    for (k = 0; k < targets; ++k) {
      if (w->led[tick * targets + k]) {
        memcpy(w->target + TARGET * k, w->lead + TARGET * (tick * targets + k), sizeof(double) * TARGET);
      }
    }
    measure(w, w->noise + tick * w->noises);
    w->tick(w->context, w->steps * w->timestep, w->q, w->v, w->felt >= 0 ? w->force : NULL, w->command);
    if ((w->refused = refuses(w))) {
      break;
    }
    for (k = 0; k < w->shapes; ++k) {
      w->peak[k] = 0.0;
      w->began[k] = INFINITY;
    }
    advance(w);
    if (!(dot(w->data->qpos, w->data->qpos, w->nqpos) + dot(w->data->qvel, w->data->qvel, w->model->nv) < w->runaway)) {
      break;
    }
    state(w, w->true_q, w->true_v);
#define RECORD(into, from, n) memcpy(w->into + tick * (n), w->from, sizeof(double) * (n))
    w->row_t[tick] = w->steps * w->timestep;
    RECORD(row_q, true_q, w->nq);
    RECORD(row_v, true_v, w->nv);
    RECORD(row_qpos, data->qpos, w->nqpos);
    RECORD(row_rotor_speeds, speeds, w->rotors);
    RECORD(row_torques, torque, w->joints);
    RECORD(row_command, rotor_speed, w->rotors);
    RECORD(row_force, now, 3 * w->shapes);
    RECORD(row_touching, normal, w->shapes);
    RECORD(row_impulse, impulse, 3 * w->shapes);
    RECORD(row_peak, peak, w->shapes);
    RECORD(row_began, began, w->shapes);
    RECORD(row_level, level, 1);
    slips(w, w->row_slip + tick * w->shapes);
    w->row_status[tick] = *w->status;
  }
  return tick;
}
