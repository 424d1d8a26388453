/* Lexicographic answer to a tick whose strict levels cannot hold, as in impact_posture/tsid/relaxation.py.
 *
 *     min 1/2 z'Hz + g'z   subject to   lower <= [z; A z] <= upper
 *
 * Entries of level 0 always hold.  Bounds of level 1 are exceeded only as far as level 0 requires.  Then, level by
 * level, the errors are minimized as far as the levels above permit (least squares in the units of the rows).  The
 * lower levels may not change these errors.  Last, the cost is minimized.  The code is C99, has no static state,
 * allocates no memory, and has a bounded number of iterations.
 */
#ifndef IMPACT_POSTURE_RELAXATION_H
#define IMPACT_POSTURE_RELAXATION_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Bounds of at least this size are treated as infinite. */
#define RELAXATION_NONE 1e29

enum {
    RELAXATION_SOLVED = 1,      /* levels and cost are solved */
    RELAXATION_WITHOUT_COST = 2, /* only the levels are solved, because the solver failed for the cost */
    RELAXATION_INFEASIBLE = -1, /* level 0 contradicts itself */
    RELAXATION_BUDGET = -4,     /* the iterations did not suffice: repeat the previous command */
    RELAXATION_UNSOLVED = -8    /* a number is not finite, or z violates level 0: repeat the previous command */
};

typedef struct {
    int n, m;             /* number of variables and of rows */
    int levels;           /* number of levels below level 0; at most n + m */
    const double *A;      /* m x n, row-major */
    const double *lower;  /* n + m: lower bounds of the variables, then of the rows */
    const double *upper;
    const int *level;     /* n + m: level of each entry, 0 ... levels; an entry with equal bounds is an equation */
    const double *H;      /* n x n, symmetric, positive definite */
    const double *g;      /* n */
    const double *unit;   /* n: typical size of each variable if accelerations have the size 1 (forces: the mass) */
} relaxation_problem;

typedef struct {
    int iterations;       /* number of iterations of all quadratic programs */
    double violation;     /* largest violation of level 0, relative to the length of its row times the size of z, in `unit` */
} relaxation_report;

/* Return the size of the workspace in bytes.  The workspace must be aligned like a double.  Between calls, it stores
 * the active rows of each level.  Set it to zero before the first call and before an unrelated problem. */
size_t relaxation_bytes(int n, int m, int levels);

/* Return one of the codes above, and write z (n numbers) if it is positive. `budget` is the largest number of
 * iterations of all quadratic programs together.  If it did not suffice, the next call continues from the active
 * rows. */
int relaxation_solve(const relaxation_problem *problem, void *work, int budget, double *z, relaxation_report *report);

#ifdef __cplusplus
}
#endif
#endif
