/* Rows of the program, and the coordinates in which z may still move. */

static double norm(const double *a, int n) { return sqrt(ip_dot(a, a, n)); }

/* Return the derivative of an entry of [z; A z] with respect to the remaining coordinates. */
static const double *motion(const Relaxation *r, int entry) {
    const int n = r->n, row = entry - n;
    if (row < 0) return r->Z + entry * n + r->fixed;
    double *T = r->T + row * n + r->fixed;
    if (r->known[row] != r->fixed) {
        const int first = r->first[row];
        r->known[row] = r->fixed;
        ip_combine(T, n - r->fixed, r->p->A + row * n + first, 1, r->Z + first * n + r->fixed, n, r->last[row] - first);
    }
    return T;
}

/* Return the value of an entry of [z; A z]. */
static double entry_of(const Relaxation *r, const double *z, int entry) {
    const int row = entry - r->n;
    if (row < 0) return z[entry];
    const int first = r->first[row];
    return ip_dot(r->p->A + row * r->n + first, z + first, r->last[row] - first);
}

static int is_equation(const Relaxation *r, int entry) { return r->p->lower[entry] == r->p->upper[entry]; }

static double violation(const Relaxation *r, int entry) {
    return fmax(r->lower[entry] - r->value[entry], r->value[entry] - r->upper[entry]);
}

/* Return the largest violation of an entry that is treated as zero. */
static double least(const Relaxation *r, int entry) { return COUNTS * r->scale * r->length[entry]; }

/* Set r->motion_z to the change of z by a step in the remaining coordinates. */
static void find_motion(Relaxation *r, const double *step) {
    for (int i = 0; i < r->n; i++) r->motion_z[i] = ip_dot(r->Z + i * r->n + r->fixed, step, r->n - r->fixed);
}

/* Move z by the given part of r->motion_z. */
static void go(Relaxation *r, double part) {
    ip_add(r->z, part, r->motion_z, r->n);
    for (int i = 0; i < r->entries; i++) r->value[i] = entry_of(r, r->z, i);
}
