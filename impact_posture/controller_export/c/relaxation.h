/* Lexicographic answer to a tick whose strict levels cannot hold, as in impact_posture/tsid/relaxation.py.
 *
 *     min 1/2 z'Hz + g'z   subject to   lower <= [z; A z] <= upper
 *
 * Entries of level 0 always hold.  Entries of level 1 are opened only as far as those demand.  Then each level, in
 * order, comes as near to its bounds as the levels above permit (least squares in the units of its rows), and stays
 * there.  Last, the cost is minimized.  C99, no allocation, no static state, a bounded number of iterations.
 */
#ifndef IMPACT_POSTURE_RELAXATION_H
#define IMPACT_POSTURE_RELAXATION_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/* A bound of this size is none. */
#define RELAXATION_NONE 1e29

enum {
    RELAXATION_SOLVED = 1,      /* levels and cost */
    RELAXATION_WITHOUT_COST = 2, /* the levels; the cost has no minimum that the solver finds */
    RELAXATION_INFEASIBLE = -1, /* level 0 contradicts itself */
    RELAXATION_BUDGET = -4,     /* the iterations did not suffice: hold the previous command */
    RELAXATION_UNSOLVED = -8    /* a number is not finite, or level 0 is violated in the end: hold */
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
    double violation;     /* largest of level 0, relative to the length of its row times the size of z, in `unit` */
} relaxation_report;

/* Bytes of the workspace, which needs the alignment of a double.  Zero it before the first solution and wherever the
 * next problem has nothing to do with the last one: it keeps the active rows of each level. */
size_t relaxation_bytes(int n, int m, int levels);

/* Write z (n numbers) where the result is positive, and return one of the codes above.
 * `budget`: most iterations of all quadratic programs together; a tick that has too few goes on with the next one. */
int relaxation_solve(const relaxation_problem *problem, void *work, int budget, double *z, relaxation_report *report);

#ifdef __cplusplus
}
#endif
#endif
