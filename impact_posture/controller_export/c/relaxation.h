/* Lexicographic solution of a tick in which the strict priority levels are infeasible, as in
 * impact_posture/tsid/relaxation.py.
 *
 *     min 1/2 z'Hz + g'z   subject to   lower <= [z; A z] <= upper
 *
 * Each entry of [z; A z] has a level.  Entries of level 0 always hold.  The bounds of level 1 are exceeded only as
 * far as level 0 requires.  Then the errors of each level are minimized (least squares) without a change of the
 * errors of earlier levels.  Last, the cost is minimized.  The code is C99, has no static state, allocates no
 * memory, and has a bounded number of iterations.
 */
#ifndef IMPACT_POSTURE_RELAXATION_H
#define IMPACT_POSTURE_RELAXATION_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

/* Bounds of at least this size are treated as infinite. */
#define RELAXATION_NONE 1e29

/* Results.  If the result is negative, the caller must repeat the previous command. */
enum {
    RELAXATION_SOLVED = 1,      /* levels and cost are solved */
    RELAXATION_WITHOUT_COST = 2, /* only the levels are solved, because the solver failed for the cost */
    RELAXATION_INFEASIBLE = -1, /* level 0 contradicts itself */
    RELAXATION_BUDGET = -4,     /* the iterations did not suffice */
    RELAXATION_UNSOLVED = -8    /* a number is not finite, or z violates level 0 */
};

typedef struct {
    int n, m;             /* number of variables and of rows */
    int levels;           /* number of levels after level 0; at most n + m */
    const double *A;      /* m x n, row-major */
    const double *lower;  /* n + m: lower bounds of the variables, then of the rows */
    const double *upper;
    const int *level;     /* n + m: level of each entry, 0 ... levels; an entry with equal bounds is an equation */
    const double *H;      /* n x n, symmetric, positive definite */
    const double *g;      /* n */
    const double *unit;   /* n: typical size of each variable: 1 for accelerations, the mass for forces */
} relaxation_problem;

typedef struct {
    int iterations;       /* number of iterations of all quadratic programs */
    double violation;     /* largest violation of level 0, relative to the length of its row times the size of z, in `unit` */
} relaxation_report;

/* Return the size of the workspace in bytes.  The workspace must be aligned like a double.  Between calls, the
 * workspace stores the active rows of each level.  Set the workspace to zero before the first call and before an
 * unrelated problem. */
size_t relaxation_bytes(int n, int m, int levels);

/* Solve the problem, and return one of the codes above.  Write z (n numbers) if the code is positive.  `budget` is
 * the largest total number of iterations.  If `budget` does not suffice, the next call continues from the active
 * rows. */
int relaxation_solve(const relaxation_problem *problem, void *work, int budget, double *z, relaxation_report *report);

#ifdef __cplusplus
}
#endif
#endif
