/* Lexicographic answer to a tick whose strict levels cannot hold, as in impact_posture/tsid/relaxation.py.
 *
 *     min 1/2 z'Hz + g'z   subject to   lower <= [z; A z] <= upper
 *
 * Entries of level 0 always hold.  Entries of level 1 open only as far as level 0 demands.  Then each level, in order, comes
 * as close to its bounds as the levels above permit (least squares in the units of its rows), and stays there.  Last, the
 * cost is minimized.  C99, without allocation and static state, with a bounded number of iterations.
 */
#ifndef IMPACT_POSTURE_RELAXATION_H
#define IMPACT_POSTURE_RELAXATION_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Bounds of at least this size are infinite. */
#define RELAXATION_NONE 1e29

enum {
    RELAXATION_SOLVED = 1,      /* levels and cost */
    RELAXATION_WITHOUT_COST = 2, /* levels only, because the solver failed for the cost */
    RELAXATION_INFEASIBLE = -1, /* level 0 contradicts itself */
    RELAXATION_BUDGET = -4,     /* the iterations did not suffice: hold the previous command */
    RELAXATION_UNSOLVED = -8    /* a number is not finite, or the result violates level 0: hold the previous command */
};

typedef struct {
    int n, m;             /* variables, rows */
    int levels;           /* number of levels below level 0; at most n + m */
    const double *A;      /* m x n, row-major */
    const double *lower;  /* n + m: of the variables, then of the rows */
    const double *upper;
    const int *level;     /* n + m: 0 ... levels; equal bounds make an equation */
    const double *H;      /* n x n, symmetric, positive definite */
    const double *g;      /* n */
    const double *unit;   /* n: value of a variable that compares with an acceleration of 1 (forces: the mass) */
} relaxation_problem;

typedef struct {
    int iterations;       /* of all quadratic programs */
    double violation;     /* largest violation of level 0, relative to the length of its row times the size of z, in `unit` */
} relaxation_report;

/* Bytes of the workspace, which needs the alignment of a double and keeps the active rows of each level.  Set it to zero
 * before the first solution and before an unrelated problem. */
size_t relaxation_bytes(int n, int m, int levels);

/* Return one of the codes above, and write z (n numbers) if it is positive.
 * `budget`: most iterations of all quadratic programs together.  After too few, the next call goes on from the active rows. */
int relaxation_solve(const relaxation_problem *problem, void *work, int budget, double *z, relaxation_report *report);

#ifdef __cplusplus
}
#endif
#endif
