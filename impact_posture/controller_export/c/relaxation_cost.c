/* Factorize the Hessian in the remaining coordinates, with `share` of its largest diagonal entry added to the
 * diagonal.  Return 0 if this matrix is not positive definite. */
static int factorize(Relaxation *r, double share) {
    const int n = r->n, free = n - r->fixed;
    const double *Z = r->Z + r->fixed, *H = r->p->H;
    double *HZ = r->B, *gradient = r->column, largest = 0;
    for (int i = 0; i < n; i++, H += n) {
        ip_combine(HZ + i * n, free, H, 1, Z, n, n);
        gradient[i] = -r->p->g[i] - ip_dot(H, r->z, n);
    }
    ip_combine(r->wanted, free, gradient, 1, Z, n, n);
    for (int i = 0; i < free; i++) {
        /* Compute up to four entries above the diagonal, because ip_combine is fastest for multiples of four. */
        ip_combine(r->L + i * n, i + 4 < free ? i / 4 * 4 + 4 : free, Z + i, n, HZ, n, n);
        largest = fmax(largest, r->L[i * n + i]);
    }
    for (int i = 0; i < free; i++) {
        double *row = r->L + i * n;
        row[i] += share * largest;
        for (int k = 0; k < i; k++) row[k] = (row[k] - ip_dot(row, r->L + k * n, k)) * r->L[k * n + k];
        const double d = row[i] - ip_dot(row, row, i);
        if (!(d > 1e-14 * largest)) return 0;
        row[i] = 1 / sqrt(d);
        r->wanted[i] = (r->wanted[i] - ip_dot(row, r->wanted, i)) * row[i];
    }
    return 1;
}

/* Transform whitened coordinates, in which the Hessian is the identity, to the coordinates of Z. */
static void unwhiten(const Relaxation *r, double *y) {
    for (int i = r->n - r->fixed - 1; i >= 0; i--) {
        y[i] *= r->L[i * r->n + i];
        ip_add(y, -y[i], r->L + i * r->n, i);
    }
}

/* Move to the minimum of the cost without the proximal term, while the active rows keep their values. */
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

/* Minimize the cost in the remaining coordinates.  First, a program with a proximal term determines the active rows,
 * because the cost alone may be too flat.  Afterwards, z moves to the minimum of the cost. */
static int solve_cost(Relaxation *r) {
    const int free = r->n - r->fixed;
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
        ip_add(r->wanted, unit, r->daqp.u, free);
        unwhiten(r, r->wanted);
        find_motion(r, r->wanted);
        go(r, 1);
        list_active(r);
        find_step(r);
        move(r);
        finish_cost(r);
        return 1;
    }
    return flag;
}

