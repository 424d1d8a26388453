/* Start at z = 0 with the bounds of the problem.  A coordinate is a variable divided by its typical size. */
static void begin(Relaxation *r, const relaxation_problem *p, char *work, int budget) {
    const int n = p->n;
    memset(r, 0, sizeof *r);
    place(r, work, (size_t)n, (size_t)p->m, (size_t)p->levels);
    r->p = p, r->n = n, r->entries = n + p->m, r->left = budget;
    memset(r->Z, 0, (size_t)n * (size_t)n * sizeof *r->Z);
    memset(r->z, 0, (size_t)n * sizeof *r->z);
    memset(r->value, 0, (size_t)r->entries * sizeof *r->value);
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
        r->first[row] = first, r->last[row] = last, r->known[row] = -1;
        for (int k = first; k < last; k++) r->step[k] = a[k] * p->unit[k];
        const double length = norm(r->step + first, last - first);
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
        const double value = entry_of(&r, z, i), over = fmax(p->lower[i] - value, value - p->upper[i]);
        if (!p->level[i] && !(over <= report->violation * r.scale * r.length[i]))
            report->violation = over / (r.scale * r.length[i]);
    }
    if (flag > 0 && !(report->violation <= WRONG)) flag = RELAXATION_UNSOLVED;
    return flag;
}
