/* ---- least-distance programs ---------------------------------------------------------------------------------- */

/* Write the rows of the program of a level: the inequalities of earlier levels, and all rows of `level` as soft
 * rows.  If L, the factor of the Hessian, is not null, transform the rows to whitened coordinates. */
static void list_rows(Relaxation *r, int level, const double *L) {
    const int free = r->n - r->fixed;
    const int *warm = r->warm + level * r->entries;
    int count = 0;
    double longest = 0;
    for (int i = 0; i < r->entries; i++)
        if (r->p->level[i] == level && !r->held[i]) longest = fmax(longest, r->length[i]);
    for (int i = 0; i < r->entries; i++) {
        const int of = r->p->level[i], soft = of == level && level > 0, equal = is_equation(r, i);
        if (r->held[i] || of > level || (equal && !soft)) continue;
        if (r->lower[i] <= -RELAXATION_NONE && r->upper[i] >= RELAXATION_NONE) continue;
        double *row = r->M + count * free;
        memcpy(row, motion(r, i), (size_t)free * sizeof *row);
        double size = norm(row, free);
        if (size <= FLAT * r->length[i]) continue;
        if (L) {
            for (int k = 0; k < free; k++) row[k] = (row[k] - ip_dot(L + k * r->n, row, k)) * L[k * r->n + k];
            size = norm(row, free);
        }
        r->size[count] = size;
        ip_scaled(row, 1 / size, row, free);
        /* DAQP scales the tolerance of a row by this number.  For levels, the tolerance is relative to the length of
         * the row in the units of the problem.  For the cost, the tolerance is as small as rounding errors. */
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

/* Set the bounds of the program relative to the present point or, with `wanted`, to the minimum of the cost.  Divide
 * the bounds by the largest violation, at least EXACT, and return the divisor. */
static double set_bounds(Relaxation *r, const double *wanted) {
    const int free = r->n - r->fixed;
    double largest = 0, size = 1;
    for (int i = 0; i < r->n; i++) size = fmax(size, fabs(r->z[i]) / r->length[i]);
    for (int j = 0; j < r->count; j++) {
        const int i = r->entry[j];
        const double at = r->value[i] / r->size[j] + (wanted ? ip_dot(r->M + j * free, wanted, free) : 0);
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

/* Store the active rows of a program for the next call. */
static void keep_active(Relaxation *r, int level) {
    int *warm = r->warm + level * r->entries;
    memset(warm, 0, (size_t)r->entries * sizeof *warm);
    for (int j = 0; j < r->count; j++) warm[r->entry[j]] = r->daqp.sense[j] & (DAQP_ACTIVE | DAQP_LOWER);
}

/* Turn the active rows of a program, except soft rows, into the exact rows. */
static void list_active(Relaxation *r) {
    clear_rows(r);
    for (int j = 0; j < r->daqp.n_active; j++) {
        const int at = r->daqp.WS[j], i = r->entry[at];
        if (r->daqp.sense[at] & DAQP_SOFT) continue;
        r->goal[i] = (r->daqp.sense[at] & DAQP_LOWER) ? r->lower[i] : r->upper[i];
        add_exact(r, i);
    }
}

/* After a move that no bound stopped, remove exact rows whose multiplier is zero or has the wrong sign, and remove
 * close rows that are inequalities and hold.  Return whether rows were removed. */
static int drop_rows(Relaxation *r) {
    double *force = r->column, most = 0, square = 0;
    const int exact = r->exact, near = r->near;
    int exacts = 0, nears = 0, worst = 0;
    memset(force, 0, (size_t)r->rank * sizeof *force);
    memset(r->rhs, 0, (size_t)exact * sizeof *r->rhs);
    for (int i = 0; i < near; i++) {
        const double miss = r->goal[r->close[i]] - r->value[r->close[i]];
        if (fabs(miss) <= least(r, r->close[i])) continue;
        ip_add(force, miss, r->M + i * r->n, r->rank);
        most = fmax(most, fabs(miss) * r->length[r->close[i]]);
        square += miss * miss;
    }
    for (int k = r->rank - 1; k >= 0; k--) {
        const int i = r->lead[k];
        const double *b = r->B + i * r->n, multiplier = force[k] / b[k];
        ip_add(force, -multiplier, b, k);
        r->rhs[i] = multiplier * r->length[r->rows[i]];
    }
    for (int i = 0; i < exact; i++) {
        const int row = r->rows[i];
        r->rhs[i] *= r->goal[row] == r->upper[row] ? 1 : -1;
        if (r->rhs[i] < r->rhs[worst]) worst = i;
    }
    /* If the last move brought no progress, remove only the exact row with the worst multiplier.  If more rows were
     * removed where many bounds meet, the next move could have length zero. */
    const int all = square < (1 - PROGRESS) * r->square;
    for (int i = 0; i < exact; i++)
        if (most > 0 && (r->rhs[i] > COUNTS * most || (!all && i != worst))) r->rows[exacts++] = r->rows[i];
    for (int i = 0; i < near; i++)
        if (is_equation(r, r->close[i]) || violation(r, r->close[i]) > least(r, r->close[i])) r->close[nears++] = r->close[i];
    /* If the last move brought no progress and no exact row is removed, keep all rows.  The iteration could otherwise
     * repeat without end. */
    if (exacts + nears == exact + near || (exacts == exact && !all)) return 0;
    r->square = square;
    clear_rows(r);
    for (int i = 0; i < exacts; i++) add_exact(r, r->rows[i]);
    for (int i = 0; i < nears; i++) add_near(r, r->close[i]);
    return 1;
}

/* Turn the equations and the violated rows of the level into the close rows.  If the level cannot hold, turn the
 * active rows of earlier levels into the exact rows. */
static void list_held(Relaxation *r, int level, int missed) {
    clear_rows(r);
    if (missed) list_active(r);
    for (int i = 0; i < r->entries; i++) {
        if (r->held[i] || r->p->level[i] != level || !(is_equation(r, i) || violation(r, i) > least(r, i))) continue;
        r->goal[i] = r->value[i] > r->upper[i] ? r->upper[i] : r->lower[i];
        add_near(r, i);
    }
}

/* Compute the exact solution of a level from approximate active rows.  Return the number of reflected coordinates
 * that the level determines. */
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
    /* The moves did not reach the optimum of the level.  Accept the point, so that its rows keep their values. */
    list_held(r, level, missed);
    for (int i = 0; i < r->exact; i++) r->goal[r->rows[i]] = r->value[r->rows[i]];
    for (int i = 0; i < r->near; i++) r->goal[r->close[i]] = r->value[r->close[i]];
    return find_step(r);
}

/* Minimize the error of a level without changing the errors of earlier levels.  Later levels do not change the error
 * that this function reaches. */
static int solve_level(Relaxation *r, int level) {
    int missed = 0, same = 0;
    list_rows(r, level, NULL);
    for (int k = 0; k < MOST_STEPS && !same && r->count; k++) {
        const double unit = set_bounds(r, NULL);
        const int left = r->left;
        r->daqp.reuse_ind = 0;
        int flag = k ? run(r) : start(r);
        if (flag <= 0 && flag != DAQP_EXIT_ITERLIMIT && !k) {
            /* The solver failed.  A larger weight of the step makes the program easier to solve. */
            for (int j = 0; j < r->count; j++) r->daqp.rho_us[j] = r->daqp.rho_ls[j] *= 100;
            flag = start(r);
        }
        keep_active(r, level);
        if (flag == DAQP_EXIT_ITERLIMIT || (flag <= 0 && level <= 1 && !k)) return flag;
        if (flag <= 0) break;
        find_motion(r, r->daqp.u);
        go(r, unit);
        missed = 0;
        for (int j = 0; j < r->count && !missed; j++)
            missed = (r->daqp.sense[j] & DAQP_SOFT) && violation(r, r->entry[j]) > least(r, r->entry[j]);
        same = !missed || (k && left - r->left == 1);
    }
    const int rank = finish_level(r, level, missed);
    /* Eliminate equations.  Inequalities stay in the program, because rounding errors can still change them. */
    for (int i = 0; i < r->exact; i++) r->held[r->rows[i]] = is_equation(r, r->rows[i]);
    for (int i = 0; i < r->near; i++) r->held[r->close[i]] = is_equation(r, r->close[i]);
    for (int k = 0; k < rank; k++) r->held[k < r->rank ? r->rows[r->lead[k]] : r->close[k - r->rank]] = 1;
    eliminate(r, rank);
    /* Widen the bounds by the rounding errors of the accepted point. */
    for (int i = 0; i < r->entries; i++)
        if (r->p->level[i] <= level) {
            r->lower[i] = fmin(r->lower[i], r->value[i]);
            r->upper[i] = fmax(r->upper[i], r->value[i]);
        }
    return r->left > 1 ? 1 : DAQP_EXIT_ITERLIMIT;
}

