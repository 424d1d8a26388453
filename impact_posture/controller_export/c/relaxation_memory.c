#include "relaxation.h"

#include <math.h>
#include <string.h>

#include "daqp.h"

/* DAQP approximates the active rows of a level in at most MOST_STEPS steps.  STEP_WEIGHT is the weight of the squared
 * step relative to the squared violation.  At most MOST_MOVES moves then lead to the exact answer.  A move takes as
 * much time as MOVE_COST iterations per row. */
#define STEP_WEIGHT 1e-5
#define MOST_STEPS 4
#define MOST_MOVES 60
#define MOVE_COST 0.1
/* DAQP may violate bounds by EXACT.  Violations up to COUNTS are treated as zero.  EXACT and COUNTS are relative to
 * the norm of the row times the norm of z. */
#define EXACT 1e-9
#define COUNTS 1e-7
/* Least relative decrease of a sum of squares. */
#define PROGRESS 1e-9
/* Largest violation of level 0 that a result may have. */
#define WRONG 1e-7
/* Largest violation of a bound in the program of the cost, relative to its unit. */
#define ROUNDING 1e-10
/* A row is constant if its remaining length is below FLAT.  PIVOT is the least pivot of an elimination.  FLAT and
 * PIVOT are relative to the length of the whole row. */
#define FLAT 1e-12
#define PIVOT 1e-8
/* Proximal terms relative to the largest diagonal entry of the Hessian, in the order of the attempts. */
static const double PROXIMAL[] = {1e-5, 1e-3};

typedef struct {
    const relaxation_problem *p;
    int n, entries, fixed, left; /* number of variables, entries of [z; A z], eliminated coordinates, iterations left */
    double *Z, *T;               /* Z, n x n: z can move along the columns from `fixed` on; T = A Z for known rows */
    double *z, *value, *lower, *upper, *length; /* present z, [z; A z], widened bounds, lengths of rows in `unit` */
    int *first, *last, *known;   /* first, last nonzero entry of a row; value of `fixed` when T was computed */
    int *held;                   /* whether each entry is eliminated */
    double *goal;                /* desired values of exact and close rows */
    double *B, *v, *tau, *rhs, *step, *column; /* work arrays of an elimination */
    double *motion_z;            /* change of z by a step, Z times the step */
    int *rows, *lead, *close;    /* exact rows; exact row that reflection k maps; close rows (least squares) */
    int exact, near, rank;       /* number of exact rows, of close rows, and of coordinates that the exact rows use */
    double *L, *wanted;          /* factor of the Hessian (1/L on the diagonal); minimum of the cost, whitened */
    DAQPWorkspace daqp;
    DAQPSettings settings;
    double *M, *size;            /* rows of the program, scaled to the length 1, and their original lengths */
    int *entry, count;           /* entry of [z; A z] of each row in M; number of these rows */
    int *warm;                   /* (levels + 2) x entries: active rows of each program in the last call */
    double square;               /* sum of squared errors of a level after the last move that no bound stopped */
    double tolerance, scale;     /* violation that DAQP may leave; largest entry of z, in `unit` */
} Relaxation;

/* Reserve an array behind the earlier arrays in the workspace; if base is null, only count its bytes. */
static void *take(char *base, size_t *used, size_t count, size_t size) {
    char *array = base ? base + *used : NULL;
    *used += (count * size + sizeof(double) - 1) / sizeof(double) * sizeof(double);
    return array;
}

static size_t place(Relaxation *r, char *base, size_t n, size_t m, size_t levels) {
    const size_t e = n + m, active = n + e + 2;
    size_t used = 0;
    const struct { double **array; size_t count; } doubles[] = {
        {&r->Z, n * n}, {&r->T, m * n}, {&r->z, n}, {&r->value, e}, {&r->lower, e}, {&r->upper, e},
        {&r->length, e}, {&r->B, e * n}, {&r->v, n * n}, {&r->tau, n}, {&r->rhs, e}, {&r->goal, e}, {&r->step, n}, {&r->motion_z, n},
        {&r->column, e},
        {&r->L, e * n}, {&r->wanted, n}, {&r->M, e * n}, {&r->size, e}, {&r->daqp.dupper, e}, {&r->daqp.dlower, e},
        {&r->daqp.scaling, e}, {&r->daqp.Mu, e}, {&r->daqp.rho_ls, e}, {&r->daqp.rho_us, e}, {&r->daqp.w_ls, e},
        {&r->daqp.lam, active}, {&r->daqp.lam_star, active}, {&r->daqp.D, active}, {&r->daqp.xldl, active},
        {&r->daqp.zldl, active}, {&r->daqp.L, active * (active + 1) / 2}, {&r->daqp.u, n}, {&r->daqp.xold, n},
    };
    const struct { int **array; size_t count; } ints[] = {
        {&r->warm, (levels + 2) * e}, {&r->first, m}, {&r->last, m}, {&r->known, m}, {&r->held, e}, {&r->rows, e},
        {&r->lead, n}, {&r->close, e}, {&r->entry, e},
        {&r->daqp.sense, e}, {&r->daqp.WS, active}, {&r->daqp.prox_mask, n},
    };
    /* The active rows (`warm`) come first, because the next call reads them. */
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

