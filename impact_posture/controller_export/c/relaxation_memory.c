#include "relaxation.h"

#include <math.h>
#include <string.h>

#include "daqp.h"

/* DAQP finds the active rows of a level nearly, with this weight of the step (squared) against the violation, by steps
 * that each start at the last answer.  The exact answer then follows by moves with eliminated rows, which a bound may
 * stop, and which count against the budget like so many iterations for each row (as long as DAQP's, by measurement). */
#define STEP_WEIGHT 1e-5
#define MOST_STEPS 4
#define MOST_MOVES 60
#define MOVE_COST 0.1
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
    double *Z, *T;               /* n x n: z moves by the columns from `fixed` on; A Z, row by row where it is known */
    double *z, *value, *lower, *upper, *length; /* the point, [z; A z], opened bounds, lengths in `unit` */
    int *first, *last, *known;   /* range of a row's entries that are not zero; for which `fixed` its motion is known */
    int *held;                   /* whether an entry is eliminated */
    double *goal;                /* values that listed rows are to have */
    double *B, *v, *tau, *rhs, *step, *column; /* of an elimination */
    double *way;                 /* Z times a step */
    int *rows, *lead, *own;      /* exact rows; those whose reflection is the k-th; rows to come near */
    int exact, near, rank;       /* their numbers, and the number of coordinates that the exact rows take */
    double *L, *wanted;          /* factor of the reduced cost (1/L on the diagonal), its minimum in whitened coordinates */
    DAQPWorkspace daqp;
    DAQPSettings settings;
    double *M, *size;            /* normalized rows of a least-distance program, and their former lengths */
    int *entry, count;           /* entries of these rows */
    int *warm;                   /* levels + 2 times entries: active rows of each program at the last solution */
    double square;               /* sum of squares that a level missed after its last whole move */
    double tolerance, scale;     /* violation that DAQP may leave; size of the point, in `unit` */
} Relaxation;

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
        {&r->length, e}, {&r->B, e * n}, {&r->v, n * n}, {&r->tau, n}, {&r->rhs, e}, {&r->goal, e}, {&r->step, n}, {&r->way, n},
        {&r->column, e},
        {&r->L, e * n}, {&r->wanted, n}, {&r->M, e * n}, {&r->size, e}, {&r->daqp.dupper, e}, {&r->daqp.dlower, e},
        {&r->daqp.scaling, e}, {&r->daqp.Mu, e}, {&r->daqp.rho_ls, e}, {&r->daqp.rho_us, e}, {&r->daqp.w_ls, e},
        {&r->daqp.lam, active}, {&r->daqp.lam_star, active}, {&r->daqp.D, active}, {&r->daqp.xldl, active},
        {&r->daqp.zldl, active}, {&r->daqp.L, active * (active + 1) / 2}, {&r->daqp.u, n}, {&r->daqp.xold, n},
    };
    const struct { int **array; size_t count; } ints[] = {
        {&r->warm, (levels + 2) * e}, {&r->first, m}, {&r->last, m}, {&r->known, m}, {&r->held, e}, {&r->rows, e},
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

