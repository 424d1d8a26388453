/* ---- elimination --------------------------------------------------------------------------------------------- */

/* Compute the reflection I - tau v v' that maps x, which is not zero, to its first coordinate. */
static double reflector(double *v, const double *x, int count) {
    const double s = norm(x, count), head = x[0];
    memmove(v, x, (size_t)count * sizeof *v);
    v[0] += head > 0 ? s : -s;
    return 1 / (s * (s + fabs(head)));
}

static void reflect(const double *v, double tau, double *x, int count) { ip_add(x, -tau * ip_dot(v, x, count), v, count); }

/* Transform a step from the reflected coordinates to the coordinates of Z. */
static void turn_back(const Relaxation *r, double *x, int rank) {
    for (int k = rank - 1; k >= 0; k--)
        reflect(r->v + k * r->n, r->tau[k], x + k, r->n - r->fixed - k);
}

/* Minimize ||B x - rhs|| for `rows` >= `columns` of full rank; B and rhs are overwritten. */
static void least_squares(double *B, int stride, int rows, int columns, double *rhs, double *x, double *v) {
    for (int c = 0; c < columns; c++) {
        const int count = rows - c;
        for (int i = 0; i < count; i++) v[i] = B[(c + i) * stride + c];
        const double tau = reflector(v, v, count);
        for (int j = c; j <= columns; j++) {
            double sum = 0, *to = j < columns ? B + c * stride + j : rhs + c;
            const int next = j < columns ? stride : 1;
            for (int i = 0; i < count; i++) sum += v[i] * to[i * next];
            for (int i = 0; i < count; i++) to[i * next] -= tau * sum * v[i];
        }
    }
    for (int c = columns - 1; c >= 0; c--) {
        const double *b = B + c * stride;
        x[c] = (rhs[c] - ip_dot(b + c + 1, x + c + 1, columns - c - 1)) / b[c];
    }
}

/* Transform a row to the reflected coordinates. */
static void turn_row(const Relaxation *r, double *row) {
    for (int k = 0; k < r->rank; k++) reflect(r->v + k * r->n, r->tau[k], row + k, r->n - r->fixed - k);
}

static void clear_rows(Relaxation *r) { r->exact = r->near = r->rank = 0; }

/* Add an entry to the exact rows, which reach their goals.  Exact rows depend only on the first r->rank reflected
 * coordinates. */
static void add_exact(Relaxation *r, int entry) {
    const int n = r->n, rank = r->rank, free = n - r->fixed;
    double *b = r->B + r->exact * n, *v = r->v + rank * n;
    memcpy(b, motion(r, entry), (size_t)free * sizeof *b);
    turn_row(r, b);
    if (rank < free && norm(b + rank, free - rank) > PIVOT * r->length[entry]) {
        r->tau[rank] = reflector(v, b + rank, free - rank);
        reflect(v, r->tau[rank], b + rank, free - rank);
        for (int i = 0; i < r->near; i++) reflect(v, r->tau[rank], r->M + i * n + rank, free - rank);
        r->lead[r->rank++] = r->exact;
    }
    r->rows[r->exact++] = entry;
}

/* Add an entry to the close rows, which approach their goals by least squares.  The function overwrites a row of
 * r->M. */
static void add_near(Relaxation *r, int entry) {
    double *b = r->M + r->near * r->n;
    memcpy(b, motion(r, entry), (size_t)(r->n - r->fixed) * sizeof *b);
    turn_row(r, b);
    r->close[r->near++] = entry;
}

static void swap(double *a, double *b, int count) {
    for (int j = 0; j < count; j++) {
        const double x = a[j];
        a[j] = b[j];
        b[j] = x;
    }
}

/* Compute the step r->step after which exact rows reach their goals and close rows approach their goals.  Return the
 * number of reflected coordinates that the step uses.  The coordinates after r->rank belong to the first close rows.
 * */
static int find_step(Relaxation *r) {
    const int n = r->n, rank = r->rank, free = n - r->fixed, rest = free - rank;
    double *step = r->step, *C = r->L, *rhs = r->rhs, *square = r->column, longest = 0;
    int used = 0;
    memset(step, 0, (size_t)n * sizeof *step);
    for (int k = 0; k < rank; k++) {
        const int i = r->lead[k], entry = r->rows[i];
        step[k] = (r->goal[entry] - r->value[entry] - ip_dot(r->B + i * n, step, k)) / r->B[i * n + k];
    }
    for (int i = 0; i < r->near; i++) {
        const double *b = r->M + i * n;
        memcpy(C + i * n, b + rank, (size_t)rest * sizeof *C);
        rhs[i] = r->goal[r->close[i]] - r->value[r->close[i]] - ip_dot(b, step, rank);
        square[i] = ip_dot(b + rank, b + rank, rest);
        longest = fmax(longest, r->length[r->close[i]]);
    }
    for (; used < r->near && used < rest; used++) {
        double *c = C + used * n, *v = r->v + (rank + used) * n, *tau = r->tau + rank + used;
        int best = used;
        for (int i = used; i < r->near; i++)
            if (square[i] > square[best]) best = i;
        if (best != used) {
            const int row = r->close[used];
            r->close[used] = r->close[best], r->close[best] = row;
            swap(c, C + best * n, rest);
            swap(r->M + used * n, r->M + best * n, free);
            swap(rhs + used, rhs + best, 1);
            swap(square + used, square + best, 1);
        }
        if (norm(c + used, rest - used) <= PIVOT * longest) break;
        *tau = reflector(v, c + used, rest - used);
        for (int i = used; i < r->near; i++) {
            double *b = C + i * n + used;
            reflect(v, *tau, b, rest - used);
            /* If the row nearly depends on earlier rows, the difference of squares would have few correct digits. */
            if (b[0] * b[0] < (1 - 1e-6) * square[i])
                square[i] -= b[0] * b[0];
            else
                square[i] = ip_dot(b + 1, b + 1, rest - used - 1);
        }
    }
    if (used < r->near)
        least_squares(C, n, r->near, used, rhs, step + rank, square);
    else
        for (int k = 0; k < used; k++)
            step[rank + k] = (rhs[k] - ip_dot(C + k * n, step + rank, k)) / C[k * n + k];
    turn_back(r, step, rank + used);
    return rank + used;
}

/* Set the flag `held` of all exact and close rows. */
static void hold_rows(Relaxation *r, int held) {
    for (int i = 0; i < r->exact; i++) r->held[r->rows[i]] = held;
    for (int i = 0; i < r->near; i++) r->held[r->close[i]] = held;
}

/* Move by r->step until a row of the program reaches its bound, and return the entry of this row.  If no row reaches
 * its bound, move by the whole step and return -1. */
static int move(Relaxation *r) {
    double part = 1, end = 0;
    int stop = -1;
    find_motion(r, r->step);
    hold_rows(r, 1);
    for (int j = 0; j < r->count; j++) {
        const int i = r->entry[j];
        if (r->held[i]) continue;
        const double by = entry_of(r, r->motion_z, i), room = r->tolerance * r->length[i];
        const double upper = fmax(r->upper[i], r->value[i]), lower = fmin(r->lower[i], r->value[i]);
        if (r->value[i] + part * by > upper + room)
            part = (upper - r->value[i]) / by, stop = i, end = r->upper[i];
        else if (r->value[i] + part * by < lower - room)
            part = (lower - r->value[i]) / by, stop = i, end = r->lower[i];
    }
    hold_rows(r, 0);
    go(r, part);
    if (stop >= 0) r->goal[stop] = end;
    return stop;
}

/* Eliminate the first `rank` reflected coordinates. */
static void eliminate(Relaxation *r, int rank) {
    const int n = r->n, free = n - r->fixed, rest = free - rank;
    if (rest < rank) {
        /* If few coordinates remain, it is faster to multiply Z by the reflected unit vector of each coordinate. */
        for (int c = 0; c < rest; c++) {
            double *e = r->B + c * n;
            memset(e, 0, (size_t)free * sizeof *e);
            e[rank + c] = 1;
            turn_back(r, e, rank);
        }
        for (int i = 0; i < n; i++) {
            double *z = r->Z + i * n + r->fixed;
            for (int c = 0; c < rest; c++) r->column[c] = ip_dot(z, r->B + c * n, free);
            memcpy(z + rank, r->column, (size_t)rest * sizeof *z);
        }
    } else
        for (int i = 0; i < n; i++)
            for (int k = 0; k < rank; k++)
                reflect(r->v + k * n, r->tau[k], r->Z + i * n + r->fixed + k, free - k);
    r->fixed += rank;
}

