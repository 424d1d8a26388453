#include "relaxation.h"

#include <math.h>
#include <string.h>

#include "daqp.h"

/* DAQP finds the active rows of a level nearly, with this weight of the step (squared) against the violation, by steps
 * that each start at the last answer.  The exact answer then follows by moves with eliminated rows, which a bound may
 * stop, and which count against the budget like so many iterations for each row. */
#define STEP_WEIGHT 1e-5
#define MOST_STEPS 4
#define MOST_MOVES 24
#define MOVE_COST 0.3
/* Largest violation of a bound, and the violation that counts, relative to the numbers of the problem. */
#define EXACT 1e-9
#define COUNTS 1e-7
/* Least relative decrease of a sum of squares. */
#define PROGRESS 1e-9
/* Largest violation of level 0 in the end. */
#define WRONG 1e-7
/* Largest violation of a bound in the program of the cost, relative to its unit. */
#define ROUNDING 1e-10
/* Length of a row that cannot move any more, and least pivot of an elimination, relative to the row's own length. */
#define FLAT 1e-12
#define PIVOT 1e-8
/* Tried in order: added to the reduced cost, relative to its largest entry. */
static const double PROXIMAL[] = {1e-5, 1e-3};

typedef struct {
    const relaxation_problem *p;
    int n, entries, fixed, left; /* variables, entries of [z; A z], eliminated coordinates, iterations left */
    double *Z, *T;               /* n x n and m x n: z and A z move by the columns from `fixed` on */
    double *z, *value, *lower, *upper, *length; /* the point, [z; A z], opened bounds, lengths in `unit` */
    int *first, *last, *held;    /* range of a row's entries that are not zero; whether an entry is eliminated */
    double *goal;                /* values that listed rows are to have */
    double *B, *v, *tau, *rhs, *step, *column; /* of an elimination */
    int *rows, *lead, *own;      /* exact rows; those whose reflection is the k-th; rows to come near */
    int exact, near, rank;       /* their numbers, and the number of coordinates that the exact rows take */
    double *L, *wanted;          /* Cholesky factor of the reduced cost, and its minimum in whitened coordinates */
    DAQPWorkspace daqp;
    DAQPSettings settings;
    double *M, *size;            /* normalized rows of a least-distance program, and their former lengths */
    int *entry, count;           /* entries of these rows */
    int *warm;                   /* levels + 2 times entries: active rows of each program at the last solution */
    double square;               /* sum of squares that a level missed after its last whole move */
    double tolerance, scale;     /* violation that DAQP may leave; size of the point, in `unit` */
} Relaxation;

static double dot(const double *a, const double *b, int n) {
    double s0 = 0, s1 = 0, s2 = 0, s3 = 0;
    int i = 0;
    for (; i + 3 < n; i += 4) {
        s0 += a[i] * b[i];
        s1 += a[i + 1] * b[i + 1];
        s2 += a[i + 2] * b[i + 2];
        s3 += a[i + 3] * b[i + 3];
    }
    for (; i < n; i++) s0 += a[i] * b[i];
    return (s0 + s1) + (s2 + s3);
}

static void add(double *restrict to, double factor, const double *restrict from, int n) {
    int i = 0;
    for (; i + 3 < n; i += 4) {
        to[i] += factor * from[i];
        to[i + 1] += factor * from[i + 1];
        to[i + 2] += factor * from[i + 2];
        to[i + 3] += factor * from[i + 3];
    }
    for (; i < n; i++) to[i] += factor * from[i];
}

static double norm(const double *a, int n) { return sqrt(dot(a, a, n)); }

/* Row of Z or T: how an entry moves in the coordinates that are left. */
static const double *motion(const Relaxation *r, int entry) {
    return (entry < r->n ? r->Z + entry * r->n : r->T + (entry - r->n) * r->n) + r->fixed;
}

static double value_of(const Relaxation *r, int entry) {
    if (entry < r->n) return r->z[entry];
    const int row = entry - r->n, first = r->first[row];
    return dot(r->p->A + row * r->n + first, r->z + first, r->last[row] - first);
}

static int is_equation(const Relaxation *r, int entry) { return r->p->lower[entry] == r->p->upper[entry]; }

static double violation(const Relaxation *r, int entry) {
    return fmax(r->lower[entry] - r->value[entry], r->value[entry] - r->upper[entry]);
}

/* Smallest violation of an entry that counts. */
static double least(const Relaxation *r, int entry) { return COUNTS * r->scale * r->length[entry]; }

/* Compute [z; A z]. */
static void update_values(Relaxation *r) {
    for (int i = 0; i < r->entries; i++) r->value[i] = value_of(r, i);
}

/* Compute A Z for the rows that are not eliminated. */
static void update_rows(Relaxation *r) {
    const int n = r->n, free = n - r->fixed;
    for (int row = 0; row < r->p->m; row++) {
        if (r->held[n + row]) continue;
        double *T = r->T + row * n + r->fixed;
        memset(T, 0, (size_t)free * sizeof *T);
        for (int k = r->first[row]; k < r->last[row]; k++) {
            const double a = r->p->A[row * n + k];
            if (a != 0) add(T, a, r->Z + k * n + r->fixed, free);
        }
    }
}

/* ---- elimination --------------------------------------------------------------------------------------------- */

/* Make the reflection I - tau v v' that leaves only the first number of x; x is not zero. */
static double reflector(double *v, const double *x, int count) {
    const double s = norm(x, count), head = x[0];
    memmove(v, x, (size_t)count * sizeof *v);
    v[0] += head > 0 ? s : -s;
    return 1 / (s * (s + fabs(head)));
}

static void reflect(const double *v, double tau, double *x, int count) { add(x, -tau * dot(v, x, count), v, count); }

/* Turn a move from the coordinates of turn() into those of Z. */
static void turn_back(const Relaxation *r, double *x, int rank) {
    for (int k = rank - 1; k >= 0; k--)
        reflect(r->v + k * r->n, r->tau[k], x + k, r->n - r->fixed - k);
}

/* Minimize ||B x - rhs|| for `rows` >= `columns` of full rank; B and rhs are overwritten. */
static void least_squares(double *B, int stride, int rows, int columns, double *rhs, double *x, double *v) {
    for (int c = 0; c < columns; c++) {
        const int count = rows - c;
        for (int i = 0; i < count; i++) v[i] = B[(c + i) * stride + c];
        const double tau = reflector(v, v, count);
        for (int j = c; j <= columns; j++) {
            double sum = 0, *to = j < columns ? B + c * stride + j : rhs + c;
            const int next = j < columns ? stride : 1;
            for (int i = 0; i < count; i++) sum += v[i] * to[i * next];
            for (int i = 0; i < count; i++) to[i * next] -= tau * sum * v[i];
        }
    }
    for (int c = columns - 1; c >= 0; c--) {
        const double *b = B + c * stride;
        x[c] = (rhs[c] - dot(b + c + 1, x + c + 1, columns - c - 1)) / b[c];
    }
}

/* Turn a row into the coordinates of the first reflections. */
static void turn_row(const Relaxation *r, double *row) {
    for (int k = 0; k < r->rank; k++) reflect(r->v + k * r->n, r->tau[k], row + k, r->n - r->fixed - k);
}

static void clear_rows(Relaxation *r) { r->exact = r->near = r->rank = 0; }

/* List a row that reaches its goal exactly: in the turned coordinates, only the first ones move the exact rows. */
static void add_exact(Relaxation *r, int entry) {
    const int n = r->n, rank = r->rank, free = n - r->fixed;
    double *b = r->B + r->exact * n, *v = r->v + rank * n;
    memcpy(b, motion(r, entry), (size_t)free * sizeof *b);
    turn_row(r, b);
    if (rank < free && norm(b + rank, free - rank) > PIVOT * r->length[entry]) {
        r->tau[rank] = reflector(v, b + rank, free - rank);
        reflect(v, r->tau[rank], b + rank, free - rank);
        for (int i = 0; i < r->near; i++) reflect(v, r->tau[rank], r->M + i * n + rank, free - rank);
        r->lead[r->rank++] = r->exact;
    }
    r->rows[r->exact++] = entry;
}

/* List a row that comes near its goal (least squares).  The rows of the last program, in M, are not needed any more. */
static void add_near(Relaxation *r, int entry) {
    double *b = r->M + r->near * r->n;
    memcpy(b, motion(r, entry), (size_t)(r->n - r->fixed) * sizeof *b);
    turn_row(r, b);
    r->own[r->near++] = entry;
}

static void swap(double *a, double *b, int count) {
    for (int j = 0; j < count; j++) {
        const double x = a[j];
        a[j] = b[j];
        b[j] = x;
    }
}

/* Make r->step the move by which the listed rows reach, or come near, their goals.  Return how many of the turned
 * coordinates it takes; those after r->rank are led by the first rows in r->own. */
static int find_step(Relaxation *r) {
    const int n = r->n, rank = r->rank, free = n - r->fixed, rest = free - rank;
    double *step = r->step, *C = r->L, *rhs = r->rhs, *square = r->column, longest = 0;
    int found = 0;
    memset(step, 0, (size_t)n * sizeof *step);
    for (int k = 0; k < rank; k++) {
        const int i = r->lead[k], entry = r->rows[i];
        step[k] = (r->goal[entry] - r->value[entry] - dot(r->B + i * n, step, k)) / r->B[i * n + k];
    }
    for (int i = 0; i < r->near; i++) {
        const double *b = r->M + i * n;
        memcpy(C + i * n, b + rank, (size_t)rest * sizeof *C);
        rhs[i] = r->goal[r->own[i]] - r->value[r->own[i]] - dot(b, step, rank);
        square[i] = dot(b + rank, b + rank, rest);
        longest = fmax(longest, r->length[r->own[i]]);
    }
    for (; found < r->near && found < rest; found++) {
        double *c = C + found * n, *v = r->v + (rank + found) * n, *tau = r->tau + rank + found;
        int best = found;
        for (int i = found; i < r->near; i++)
            if (square[i] > square[best]) best = i;
        if (best != found) {
            const int row = r->own[found];
            r->own[found] = r->own[best], r->own[best] = row;
            swap(c, C + best * n, rest);
            swap(r->M + found * n, r->M + best * n, free);
            swap(rhs + found, rhs + best, 1);
            swap(square + found, square + best, 1);
        }
        if (norm(c + found, rest - found) <= PIVOT * longest) break;
        *tau = reflector(v, c + found, rest - found);
        for (int i = found; i < r->near; i++) {
            double *b = C + i * n + found;
            reflect(v, *tau, b, rest - found);
            /* The difference keeps few digits where a row nearly depends on those before. */
            if (b[0] * b[0] < (1 - 1e-6) * square[i])
                square[i] -= b[0] * b[0];
            else
                square[i] = dot(b + 1, b + 1, rest - found - 1);
        }
    }
    if (found < r->near)
        least_squares(C, n, r->near, found, rhs, step + rank, square);
    else
        for (int k = 0; k < found; k++)
            step[rank + k] = (rhs[k] - dot(C + k * n, step + rank, k)) / C[k * n + k];
    turn_back(r, step, rank + found);
    return rank + found;
}

/* Mark listed rows as held, or as free. */
static void hold_rows(Relaxation *r, int held) {
    for (int i = 0; i < r->exact; i++) r->held[r->rows[i]] = held;
    for (int i = 0; i < r->near; i++) r->held[r->own[i]] = held;
}

/* Move by r->step until a row of the program stops it.  Return that row's entry, or -1 where none does. */
static int move(Relaxation *r) {
    const int n = r->n, free = n - r->fixed;
    double part = 1;
    int stop = -1;
    hold_rows(r, 1);
    for (int j = 0; j < r->count; j++) {
        const int i = r->entry[j];
        if (r->held[i]) continue;
        const double by = dot(motion(r, i), r->step, free), room = r->tolerance * r->length[i];
        const double upper = fmax(r->upper[i], r->value[i]), lower = fmin(r->lower[i], r->value[i]);
        if (r->value[i] + part * by > upper + room)
            part = (upper - r->value[i]) / by, stop = i;
        else if (r->value[i] + part * by < lower - room)
            part = (lower - r->value[i]) / by, stop = i;
    }
    hold_rows(r, 0);
    for (int i = 0; i < n; i++) r->z[i] += part * dot(r->Z + i * n + r->fixed, r->step, free);
    update_values(r);
    if (stop >= 0) r->goal[stop] = dot(motion(r, stop), r->step, free) > 0 ? r->upper[stop] : r->lower[stop];
    return stop;
}

/* Drop the rows that the answer does not need from the lists, after a whole move: exact rows without a multiplier or
 * with one of the wrong sign, and inequalities that hold.  Return whether there are any. */
static int drop_rows(Relaxation *r) {
    double *force = r->column, most = 0, square = 0;
    const int exact = r->exact, near = r->near;
    int exacts = 0, nears = 0;
    memset(force, 0, (size_t)r->rank * sizeof *force);
    memset(r->rhs, 0, (size_t)exact * sizeof *r->rhs);
    for (int i = 0; i < near; i++) {
        const double miss = r->goal[r->own[i]] - r->value[r->own[i]];
        if (fabs(miss) <= least(r, r->own[i])) continue;
        add(force, miss, r->M + i * r->n, r->rank);
        most = fmax(most, fabs(miss) * r->length[r->own[i]]);
        square += miss * miss;
    }
    for (int k = r->rank - 1; k >= 0; k--) {
        const int i = r->lead[k];
        const double *b = r->B + i * r->n, multiplier = force[k] / b[k];
        add(force, -multiplier, b, k);
        r->rhs[i] = multiplier * r->length[r->rows[i]];
    }
    for (int i = 0; i < exact; i++) {
        const int row = r->rows[i];
        const double pushes = r->goal[row] == r->upper[row] ? r->rhs[i] : -r->rhs[i];
        if (most > 0 && pushes > COUNTS * most) r->rows[exacts++] = row;
    }
    for (int i = 0; i < near; i++)
        if (is_equation(r, r->own[i]) || violation(r, r->own[i]) > least(r, r->own[i])) r->own[nears++] = r->own[i];
    /* Inequalities at their very bounds would be dropped and stop the move again without end. */
    if (exacts + nears == exact + near || (exacts == exact && !(square < (1 - PROGRESS) * r->square))) return 0;
    r->square = square;
    clear_rows(r);
    for (int i = 0; i < exacts; i++) add_exact(r, r->rows[i]);
    for (int i = 0; i < nears; i++) add_near(r, r->own[i]);
    return 1;
}

/* Leave out the first `rank` of the coordinates of turn(). */
static void eliminate(Relaxation *r, int rank) {
    const int n = r->n, free = n - r->fixed, rest = free - rank;
    if (!rank) return;
    if (rest < rank) {
        /* Few coordinates are left: Z times each of them. */
        for (int c = 0; c < rest; c++) {
            double *e = r->B + c * n;
            memset(e, 0, (size_t)free * sizeof *e);
            e[rank + c] = 1;
            turn_back(r, e, rank);
        }
        for (int i = 0; i < n; i++) {
            double *z = r->Z + i * n + r->fixed;
            for (int c = 0; c < rest; c++) r->column[c] = dot(z, r->B + c * n, free);
            memcpy(z + rank, r->column, (size_t)rest * sizeof *z);
        }
    } else
        for (int i = 0; i < n; i++)
            for (int k = 0; k < rank; k++)
                reflect(r->v + k * n, r->tau[k], r->Z + i * n + r->fixed + k, free - k);
    r->fixed += rank;
    if (rest) update_rows(r);
}

/* ---- least-distance programs ---------------------------------------------------------------------------------- */

/* List the inequalities of the levels above `level` and, as soft ones, all rows of `level`, in whitened coordinates
 * where the cost has a factor L. */
static void list_rows(Relaxation *r, int level, const double *L) {
    const int free = r->n - r->fixed;
    const int *warm = r->warm + level * r->entries;
    int count = 0;
    double longest = 0;
    for (int i = 0; i < r->entries; i++)
        if (r->p->level[i] == level && !r->held[i]) longest = fmax(longest, r->length[i]);
    for (int i = 0; i < r->entries; i++) {
        const int own = r->p->level[i], soft = own == level && level > 0, equal = is_equation(r, i);
        if (r->held[i] || own > level || (equal && !soft)) continue;
        if (r->lower[i] <= -RELAXATION_NONE && r->upper[i] >= RELAXATION_NONE) continue;
        double *row = r->M + count * free;
        memcpy(row, motion(r, i), (size_t)free * sizeof *row);
        if (norm(row, free) <= FLAT * r->length[i]) continue;
        for (int k = 0; L && k < free; k++) row[k] = (row[k] - dot(L + k * r->n, row, k)) / L[k * r->n + k];
        const double size = r->size[count] = norm(row, free);
        for (int k = 0; k < free; k++) row[k] /= size;
        /* The tolerance of a row is relative to its length in the units of the problem.  That of the cost is what
         * rounding permits; its active rows are made exact afterwards. */
        r->daqp.scaling[count] = L ? 1 : r->length[i] / size;
        const double ratio = longest / r->length[i];
        r->daqp.rho_ls[count] = r->daqp.rho_us[count] = STEP_WEIGHT * ratio * ratio;
        r->daqp.sense[count] = (soft ? DAQP_SOFT : 0) | (equal ? DAQP_ACTIVE | DAQP_IMMUTABLE : 0);
        if (warm[i] & DAQP_ACTIVE) r->daqp.sense[count] |= warm[i];
        r->entry[count++] = i;
    }
    r->count = r->daqp.m = count;
    r->daqp.n = free;
}

/* Set the bounds around the present point, or around the minimum of the cost, and return their unit. */
static double set_bounds(Relaxation *r, const double *wanted) {
    const int free = r->n - r->fixed;
    double largest = 0, size = 1;
    for (int i = 0; i < r->n; i++) size = fmax(size, fabs(r->z[i]) / r->length[i]);
    for (int j = 0; j < r->count; j++) {
        const int i = r->entry[j];
        const double at = r->value[i] / r->size[j] + (wanted ? dot(r->M + j * free, wanted, free) : 0);
        r->daqp.dupper[j] = r->upper[i] / r->size[j] - at;
        r->daqp.dlower[j] = r->lower[i] / r->size[j] - at;
        largest = fmax(largest, fmax(r->daqp.dlower[j], -r->daqp.dupper[j]));
    }
    const double unit = fmax(largest, EXACT * size);
    r->scale = size;
    r->tolerance = EXACT * (wanted ? size : fmax(size, unit));
    r->settings.primal_tol = wanted ? ROUNDING : r->tolerance / unit;
    for (int j = 0; j < r->count; j++) {
        r->daqp.dupper[j] /= unit;
        r->daqp.dlower[j] /= unit;
    }
    return unit;
}

static int run(Relaxation *r) {
    if (r->left <= 1) return DAQP_EXIT_ITERLIMIT;
    r->settings.iter_limit = r->left;
    const int flag = daqp_ldp(&r->daqp);
    r->left -= r->daqp.iterations;
    return flag;
}

static int start(Relaxation *r) {
    reset_daqp_workspace(&r->daqp);
    daqp_activate_constraints(&r->daqp);
    return run(r);
}

/* Keep the active rows of a program for the next solution. */
static void keep_active(Relaxation *r, int level) {
    int *warm = r->warm + level * r->entries;
    memset(warm, 0, (size_t)r->entries * sizeof *warm);
    for (int j = 0; j < r->count; j++) warm[r->entry[j]] = r->daqp.sense[j] & (DAQP_ACTIVE | DAQP_LOWER);
}

/* List the active rows of a program that are not soft. */
static void list_active(Relaxation *r) {
    clear_rows(r);
    for (int j = 0; j < r->daqp.n_active; j++) {
        const int at = r->daqp.WS[j], i = r->entry[at];
        if (r->daqp.sense[at] & DAQP_SOFT) continue;
        r->goal[i] = (r->daqp.sense[at] & DAQP_LOWER) ? r->lower[i] : r->upper[i];
        add_exact(r, i);
    }
}

/* List what determines the level's answer: the active rows of the levels above, then the level's own equations and
 * violated rows, which stay where they are if there is nothing to find. */
static void list_held(Relaxation *r, int level, int missed) {
    clear_rows(r);
    if (missed) list_active(r);
    for (int i = 0; i < r->entries; i++) {
        if (r->held[i] || r->p->level[i] != level || !(is_equation(r, i) || violation(r, i) > least(r, i))) continue;
        r->goal[i] = r->value[i] > r->upper[i] ? r->upper[i] : r->lower[i];
        add_near(r, i);
    }
}

/* Find the exact answer of a level from nearly the right rows, and return how many coordinates they take. */
static int finish_level(Relaxation *r, int level, int missed) {
    int last = -1;
    r->square = INFINITY;
    list_held(r, level, missed);
    for (int k = 0; k < MOST_MOVES; k++) {
        const int cost = (int)(MOVE_COST * (r->exact + r->near));
        if (r->left <= cost) break;
        r->left -= cost;
        const int rank = find_step(r), stop = move(r);
        if (stop < 0 && !drop_rows(r)) return rank;
        if (stop < 0) continue;
        if (stop == last) break;
        last = stop;
        if (r->p->level[stop] < level || level == 0)
            add_exact(r, stop);
        else
            add_near(r, stop);
    }
    /* The point is good, if not the best: its rows stay as they are. */
    list_held(r, level, missed);
    for (int i = 0; i < r->exact; i++) r->goal[r->rows[i]] = r->value[r->rows[i]];
    for (int i = 0; i < r->near; i++) r->goal[r->own[i]] = r->value[r->own[i]];
    return find_step(r);
}

/* Bring the point as near to a level as the levels above permit, then keep it there. */
static int solve_level(Relaxation *r, int level) {
    const int free = r->n - r->fixed;
    int missed = 0, same = 0;
    list_rows(r, level, NULL);
    for (int k = 0; k < MOST_STEPS && !same && r->count; k++) {
        const double unit = set_bounds(r, NULL);
        const int left = r->left;
        r->daqp.reuse_ind = 0;
        int flag = k ? run(r) : start(r);
        if (flag <= 0 && flag != DAQP_EXIT_ITERLIMIT && !k) {
            /* A larger weight is easier. */
            for (int j = 0; j < r->count; j++) r->daqp.rho_us[j] = r->daqp.rho_ls[j] *= 100;
            flag = start(r);
        }
        keep_active(r, level);
        if (flag == DAQP_EXIT_ITERLIMIT || (flag <= 0 && level <= 1 && !k)) return flag;
        if (flag <= 0) break;
        for (int i = 0; i < r->n; i++) r->z[i] += unit * dot(r->Z + i * r->n + r->fixed, r->daqp.u, free);
        update_values(r);
        missed = 0;
        for (int j = 0; j < r->count && !missed; j++)
            missed = (r->daqp.sense[j] & DAQP_SOFT) && violation(r, r->entry[j]) > least(r, r->entry[j]);
        same = !missed || (k && left - r->left == 1);
    }
    const int rank = finish_level(r, level, missed);
    /* A dependent row may still move by rounding: an inequality goes on as one. */
    for (int i = 0; i < r->exact; i++) r->held[r->rows[i]] = is_equation(r, r->rows[i]);
    for (int i = 0; i < r->near; i++) r->held[r->own[i]] = is_equation(r, r->own[i]);
    for (int k = 0; k < rank; k++) r->held[k < r->rank ? r->rows[r->lead[k]] : r->own[k - r->rank]] = 1;
    eliminate(r, rank);
    /* The point is a solution, whatever rounding makes of its rows. */
    for (int i = 0; i < r->entries; i++)
        if (r->p->level[i] <= level) {
            r->lower[i] = fmin(r->lower[i], r->value[i]);
            r->upper[i] = fmax(r->upper[i], r->value[i]);
        }
    return r->left > 1 ? 1 : DAQP_EXIT_ITERLIMIT;
}

/* Factorize the reduced cost plus `share` of its largest entry; false where it is not positive. */
static int factorize(Relaxation *r, double share) {
    const int n = r->n, free = n - r->fixed;
    double *HZ = r->B, largest = 0;
    for (int i = 0; i < n; i++) {
        double *row = HZ + i * n;
        memset(row, 0, (size_t)free * sizeof *row);
        for (int k = 0; k < n; k++) {
            const double h = r->p->H[(i > k ? i : k) * n + (i > k ? k : i)];
            if (h != 0) add(row, h, r->Z + k * n + r->fixed, free);
        }
    }
    memset(r->wanted, 0, (size_t)free * sizeof *r->wanted);
    for (int i = 0; i < free; i++) memset(r->L + i * n, 0, (size_t)free * sizeof *r->L);
    for (int k = 0; k < n; k++) {
        const double *z = r->Z + k * n + r->fixed, *h = HZ + k * n;
        for (int i = 0; i < free; i++) add(r->L + i * n, z[i], h, i + 1);
        add(r->wanted, -r->p->g[k], z, free);
        add(r->wanted, -r->z[k], h, free);
    }
    for (int i = 0; i < free; i++) largest = fmax(largest, r->L[i * n + i]);
    for (int i = 0; i < free; i++) {
        double *row = r->L + i * n;
        row[i] += share * largest;
        for (int k = 0; k < i; k++) row[k] = (row[k] - dot(row, r->L + k * n, k)) / r->L[k * n + k];
        const double d = row[i] - dot(row, row, i);
        if (!(d > 1e-14 * largest)) return 0;
        row[i] = sqrt(d);
        r->wanted[i] = (r->wanted[i] - dot(row, r->wanted, i)) / row[i];
    }
    return 1;
}

/* Turn whitened coordinates into those of Z. */
static void unwhiten(const Relaxation *r, double *y) {
    for (int i = r->n - r->fixed - 1; i >= 0; i--) {
        y[i] /= r->L[i * r->n + i];
        add(y, -y[i], r->L + i * r->n, i);
    }
}

/* Move to the minimum of the cost with the active rows of its program held, where a proximal term has kept it off. */
static void finish_cost(Relaxation *r) {
    for (int k = 0; k < MOST_MOVES; k++) {
        hold_rows(r, 1);
        eliminate(r, r->rank);
        const int free = r->n - r->fixed;
        if (!free || !factorize(r, 0)) return;
        memcpy(r->step, r->wanted, (size_t)free * sizeof *r->step);
        unwhiten(r, r->step);
        clear_rows(r);
        const int stop = move(r);
        if (stop < 0) return;
        add_exact(r, stop);
    }
}

/* Minimize the cost in the coordinates that are left.  Its active rows are found with a proximal term, because the cost
 * may be too flat; then the point moves to its minimum. */
static int solve_cost(Relaxation *r) {
    const int n = r->n, free = n - r->fixed;
    int flag = 0;
    if (!free) return 1;
    for (int k = 0; k < (int)(sizeof PROXIMAL / sizeof *PROXIMAL); ++k) {
        if (!factorize(r, PROXIMAL[k])) continue;
        list_rows(r, r->p->levels + 1, r->L);
        const double unit = set_bounds(r, r->wanted);
        flag = start(r);
        keep_active(r, r->p->levels + 1);
        if (flag == DAQP_EXIT_ITERLIMIT) return flag;
        if (flag <= 0) continue;
        add(r->wanted, unit, r->daqp.u, free);
        unwhiten(r, r->wanted);
        for (int i = 0; i < n; i++) r->z[i] += dot(r->Z + i * n + r->fixed, r->wanted, free);
        update_values(r);
        list_active(r);
        find_step(r);
        move(r);
        finish_cost(r);
        return 1;
    }
    return flag;
}

/* ---- the whole ------------------------------------------------------------------------------------------------ */

/* Place an array after the others; without a base, count only. */
static void *take(char *base, size_t *used, size_t count, size_t size) {
    char *found = base ? base + *used : NULL;
    *used += (count * size + sizeof(double) - 1) / sizeof(double) * sizeof(double);
    return found;
}

static size_t place(Relaxation *r, char *base, size_t n, size_t m, size_t levels) {
    const size_t e = n + m, active = n + e + 2;
    size_t used = 0;
    const struct { double **array; size_t count; } doubles[] = {
        {&r->Z, n * n}, {&r->T, m * n}, {&r->z, n}, {&r->value, e}, {&r->lower, e}, {&r->upper, e},
        {&r->length, e}, {&r->B, e * n}, {&r->v, n * n}, {&r->tau, n}, {&r->rhs, e}, {&r->goal, e}, {&r->step, n},
        {&r->column, e},
        {&r->L, e * n}, {&r->wanted, n}, {&r->M, e * n}, {&r->size, e}, {&r->daqp.dupper, e}, {&r->daqp.dlower, e},
        {&r->daqp.scaling, e}, {&r->daqp.Mu, e}, {&r->daqp.rho_ls, e}, {&r->daqp.rho_us, e}, {&r->daqp.w_ls, e},
        {&r->daqp.lam, active}, {&r->daqp.lam_star, active}, {&r->daqp.D, active}, {&r->daqp.xldl, active},
        {&r->daqp.zldl, active}, {&r->daqp.L, active * (active + 1) / 2}, {&r->daqp.u, n}, {&r->daqp.xold, n},
    };
    const struct { int **array; size_t count; } ints[] = {
        {&r->warm, (levels + 2) * e}, {&r->first, m}, {&r->last, m}, {&r->held, e}, {&r->rows, e},
        {&r->lead, n}, {&r->own, e}, {&r->entry, e},
        {&r->daqp.sense, e}, {&r->daqp.WS, active}, {&r->daqp.prox_mask, n},
    };
    /* The active rows, which outlive a solution, come first. */
    for (size_t k = 0; k < sizeof ints / sizeof *ints; k++)
        *ints[k].array = take(base, &used, ints[k].count, sizeof(int));
    for (size_t k = 0; k < sizeof doubles / sizeof *doubles; k++)
        *doubles[k].array = take(base, &used, doubles[k].count, sizeof(double));
    return used;
}

size_t relaxation_bytes(int n, int m, int levels) {
    Relaxation r;
    return place(&r, NULL, (size_t)n, (size_t)m, (size_t)levels);
}

/* Set the point to zero, the bounds to those of the problem, and the coordinates to the scaled variables. */
static void begin(Relaxation *r, const relaxation_problem *p, char *work, int budget) {
    const int n = p->n;
    memset(r, 0, sizeof *r);
    place(r, work, (size_t)n, (size_t)p->m, (size_t)p->levels);
    r->p = p, r->n = n, r->entries = n + p->m, r->left = budget;
    memset(r->Z, 0, (size_t)n * (size_t)n * sizeof *r->Z);
    memset(r->z, 0, (size_t)n * sizeof *r->z);
    memset(r->held, 0, (size_t)r->entries * sizeof *r->held);
    memset(r->daqp.w_ls, 0, (size_t)r->entries * sizeof(double));
    memcpy(r->lower, p->lower, (size_t)r->entries * sizeof *r->lower);
    memcpy(r->upper, p->upper, (size_t)r->entries * sizeof *r->upper);
    for (int i = 0; i < n; i++) r->Z[i * n + i] = r->length[i] = p->unit[i];
    for (int row = 0; row < p->m; row++) {
        const double *a = p->A + row * n;
        int first = 0, last = n;
        while (first < n && a[first] == 0) first++;
        while (last > first && a[last - 1] == 0) last--;
        r->first[row] = first, r->last[row] = last;
        double *T = r->T + row * n;
        for (int k = 0; k < n; k++) T[k] = a[k] * p->unit[k];
        const double length = norm(T, n);
        r->length[n + row] = length > 0 ? length : 1;
    }
    DAQPWorkspace *d = &r->daqp;
    d->settings = &r->settings;
    d->M = r->M, d->w_us = d->w_ls, d->x = d->u, d->outer_iter = 1;
    r->settings = (DAQPSettings){.dual_tol = DAQP_DEFAULT_DUAL_TOL, .zero_tol = DAQP_DEFAULT_ZERO_TOL,
        .pivot_tol = DAQP_DEFAULT_PIVOT_TOL, .progress_tol = DAQP_DEFAULT_PROG_TOL, .cycle_tol = DAQP_DEFAULT_CYCLE_TOL,
        .fval_bound = DAQP_INF, .rho_soft = STEP_WEIGHT, .sing_tol = DAQP_DEFAULT_SING_TOL,
        .refactor_tol = DAQP_DEFAULT_REFACTOR_TOL, .eq_reduction = DAQP_EQ_REDUCTION_OFF};
}

int relaxation_solve(const relaxation_problem *p, void *work, int budget, double *z, relaxation_report *report) {
    Relaxation r;
    int flag = 1;
    begin(&r, p, work, budget);
    update_values(&r);
    for (int i = 0; i < r.entries; i++)
        if (!p->level[i] && is_equation(&r, i)) {
            r.goal[i] = p->lower[i];
            add_exact(&r, i);
        }
    find_step(&r);
    move(&r);
    hold_rows(&r, 1);
    eliminate(&r, r.rank);
    for (int level = p->levels ? 1 : 0; level <= p->levels && flag > 0 && r.fixed < r.n; level++)
        flag = solve_level(&r, level);
    if (flag > 0) {
        flag = solve_cost(&r);
        if (flag != DAQP_EXIT_ITERLIMIT) flag = flag > 0 ? RELAXATION_SOLVED : RELAXATION_WITHOUT_COST;
    } else if (flag != DAQP_EXIT_ITERLIMIT)
        flag = RELAXATION_INFEASIBLE;
    if (flag == DAQP_EXIT_ITERLIMIT) flag = RELAXATION_BUDGET;
    memcpy(z, r.z, (size_t)p->n * sizeof *z);
    report->iterations = budget - r.left;
    report->violation = 0;
    for (int i = 0; i < r.entries; i++) {
        const double value = value_of(&r, i), over = fmax(p->lower[i] - value, value - p->upper[i]);
        if (!p->level[i] && !(over <= report->violation * r.scale * r.length[i]))
            report->violation = over / (r.scale * r.length[i]);
    }
    if (flag > 0 && !(report->violation <= WRONG)) flag = RELAXATION_UNSOLVED;
    return flag;
}
