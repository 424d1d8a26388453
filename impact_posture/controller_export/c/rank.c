/* Strict levels of any rank, as LevelRank has them: dependent rows leave the program, nearly dependent rows are damped. */

/* Singular value, over the length of a level's longest row, below which a direction is damped; the share of it below
 * which a direction is dropped; the least 1 - alpha. */
#define IP_SINGULAR 2e-2
#define IP_DROPPED 1e-9
#define IP_LEAST 1e-8

/* Whether the equations are independent, as LevelRank decides: no singular value of the scaled rows is below 0.02.  No
 * singular value moves further than the matrix does, so most ticks need no decomposition. */
static void ip_measure_rank(ip_context *c)
{
#if IP_LEVELS
  enum { N = IP_EQUATIONS };
  const double least = IP_SINGULAR;
  double *G = c->scratch, *S = c->scratch + N * N, way = 0.0, low, high, trace = 0.0;
  double way_of[IP_VARIABLES];
  int i, j, k;
  for (i = 0; i < N; ++i) {
    const double s = 1.0 / c->length[i];
    for (j = 0; j < IP_NV + IP_SPARE; ++j) {
      way_of[j] = (c->rows[i][j] - c->reference[i][j]) * s;
    }
    for (; j < IP_VARIABLES; ++j) {
      way_of[j] = (c->rows[i][j] - c->reference[i][j]) * s * c->m.M[0];
    }
    way += ip_dot(way_of, way_of, IP_VARIABLES);
  }
  if (way < c->space) {
    return;
  }
  memcpy(c->reference, c->rows, sizeof c->reference);
  c->space = 0.0;
  c->independent = 1;
  if (!isfinite(way)) {
    return;
  }
  for (i = 0; i < N; ++i) {
    for (j = 0; j <= i; ++j) {
      double sum = 0.0;
      for (k = 0; k < IP_VARIABLES; ++k) {
        const double unit = k < IP_NV + IP_SPARE ? 1.0 : c->m.M[0];
        sum += c->rows[i][k] * c->rows[j][k] * unit * unit;
      }
      G[i * N + j] = G[j * N + i] = sum / (c->length[i] * c->length[j]);
    }
    trace += G[i * (N + 1)];
  }
  /* Squares of a lower and an upper bound on the least singular value. */
  low = least * least;
  high = trace / N;
  for (k = 0; k < 7; ++k) {
    const double middle = k ? sqrt(low * high) : low;
    memcpy(S, G, sizeof(double) * N * N);
    for (i = 0; i < N; ++i) {
      S[i * (N + 1)] -= middle;
    }
    if (ip_cholesky(S, N)) {
      low = middle;
    } else if (k) {
      high = middle;
    } else {
      c->independent = 0;
      return;
    }
  }
  c->space = (sqrt(low) - least) * (sqrt(low) - least);
#else
  c->independent = 1;
#endif
}

/* Lengths of the equations, by which their rank is measured: the longest row of a level. */
static void ip_begin_rank(ip_context *c)
{
  int r = IP_BLIND, i, j, k;
  for (i = 0; i < IP_EQUATIONS; ++i) {
    double sum = 0.0;
    for (j = 0; j < IP_VARIABLES; ++j) {
      const double x = c->rows[i][j] * (j < IP_NV + IP_SPARE ? 1.0 : c->m.M[0]);
      sum += x * x;
    }
    c->length[i] = sqrt(sum);
  }
  for (k = 0; k < IP_LEVELS; ++k) {
    double most = 0.0;
    for (i = r; i < r + ip_level_rows[k]; ++i) {
      most = fmax(most, c->length[i]);
    }
    for (i = r; i < r + ip_level_rows[k]; ++i) {
      c->length[i] = most;
    }
    r += ip_level_rows[k];
  }
  for (i = 0; i < IP_EQUATIONS; ++i) {
    c->length[i] = c->length[i] == 0.0 ? 1.0 : c->length[i];
  }
  c->space = -1.0;
  ip_measure_rank(c);
}

#if IP_LEVELS
/* Rotate the k rows of B, of n numbers, until they are orthogonal, by U, of orthogonal rows: B becomes U B.  These are the
 * left singular vectors and, times the singular values, the right ones (Hestenes 1958). */
static void ip_orthogonalize(double *B, double *U, int k, int n)
{
  int i, j, l, sweep, turned = 1;
  for (i = 0; i < k * k; ++i) {
    U[i] = i % (k + 1) == 0 ? 1.0 : 0.0;
  }
  for (sweep = 0; sweep < 30 && turned; ++sweep) {
    turned = 0;
    for (i = 0; i < k; ++i) {
      for (j = i + 1; j < k; ++j) {
        double *x = B + i * n, *y = B + j * n, *u = U + i * k, *w = U + j * k;
        const double xx = ip_dot(x, x, n), yy = ip_dot(y, y, n), xy = ip_dot(x, y, n), half = 0.5 * (yy - xx);
        double t, c, s;
        if (!(fabs(xy) > 1e-15 * sqrt(xx * yy)) || xy == 0.0) {
          continue;
        }
        turned = 1;
        t = xy / (fabs(half) + sqrt(half * half + xy * xy));
        t = half < 0.0 ? -t : t;
        c = 1.0 / sqrt(1.0 + t * t);
        s = t * c;
        for (l = 0; l < n; ++l) {
          const double a = x[l], b = y[l];
          x[l] = c * a - s * b;
          y[l] = s * a + c * b;
        }
        for (l = 0; l < k; ++l) {
          const double a = u[l], b = w[l];
          u[l] = c * a - s * b;
          w[l] = s * a + c * b;
        }
      }
    }
  }
}

/* Z = Z (I - share v v'/v'v) for a row v of length s. */
static void ip_remove(double *Z, const double *v, double s, double share, int n)
{
  int i, j;
  for (i = 0; i < n; ++i) {
    const double along = share * ip_dot(Z + i * n, v, n) / (s * s);
    for (j = 0; j < n; ++j) {
      Z[i * n + j] -= along * v[j];
    }
  }
}

/* Replace the rows of the levels by independent ones, with open bounds where they are none, and add the damped ones to
 * the upper triangle of H and to g, which pulls. */
static void ip_reduce(ip_context *c, double *H, double *g)
{
  enum { N = IP_VARIABLES };
  double *Z = H + N * N, *B = Z + N * N, *U = B + IP_EQUATIONS * N, *turned = U + IP_EQUATIONS * IP_EQUATIONS;
  double wanted[IP_EQUATIONS];
  int i, j, k, l, r = IP_BLIND;
  for (i = 0; i < N; ++i) {
    for (j = 0; j < N; ++j) {
      Z[i * N + j] = i != j ? 0.0 : i < IP_NV + IP_SPARE ? 1.0 : c->m.M[0];
    }
  }
  for (i = 0; i < IP_BLIND; ++i) {
    for (j = 0; j < N; ++j) {
      B[i * N + j] = c->rows[i][j] * Z[j * (N + 1)] / c->length[i];
    }
  }
  ip_orthogonalize(B, U, IP_BLIND, N);
  for (i = 0; i < IP_BLIND; ++i) {
    ip_remove(Z, B + i * N, sqrt(ip_dot(B + i * N, B + i * N, N)), 1.0, N);
  }
  for (k = 0; k < IP_LEVELS; r += ip_level_rows[k++]) {
    const int count = ip_level_rows[k];
    double top = 0.0, bottom = 0.0, weight;
    for (i = 0; i < count; ++i) {
      for (j = 0; j < N; ++j) {
        B[i * N + j] = 0.0;
      }
      for (l = 0; l < N; ++l) {
        for (j = 0; j < N; ++j) {
          B[i * N + j] += c->rows[r + i][l] * Z[l * N + j];
        }
      }
    }
    ip_orthogonalize(B, U, count, N);
    for (i = 0; i < count; ++i) {
      wanted[i] = 0.0;
      for (j = 0; j < N; ++j) {
        turned[i * N + j] = 0.0;
      }
      for (l = 0; l < count; ++l) {
        wanted[i] += U[i * count + l] * c->low[IP_SIMPLE + r + l];
        for (j = 0; j < N; ++j) {
          turned[i * N + j] += U[i * count + l] * c->rows[r + l][j];
        }
      }
    }
    /* The mean weight of the cost over the directions that are left. */
    for (i = 0; i < IP_NV; ++i) {
      for (j = i; j < IP_NV; ++j) {
        top += (i == j ? 1.0 : 2.0) * c->cost[i * IP_NV + j] * ip_dot(Z + i * N, Z + j * N, N);
      }
      bottom += ip_dot(Z + i * N, Z + i * N, N);
    }
    weight = top / bottom;
    for (i = 0; i < count; ++i) {
      const double *v = B + i * N, s = sqrt(ip_dot(v, v, N)), x = fmin(s / (IP_SINGULAR * c->length[r]), 1.0);
      const double alpha = ip_smooth(x), strength = weight * alpha / fmax(1.0 - alpha, IP_LEAST) / (s * s);
      memcpy(c->rows[r + i], turned + i * N, sizeof(double) * N);
      c->wanted_rows[r + i] = wanted[i];
      c->low[IP_SIMPLE + r + i] = x < 1.0 ? -INFINITY : wanted[i];
      c->high[IP_SIMPLE + r + i] = x < 1.0 ? INFINITY : wanted[i];
      if (x < 1.0 && x > IP_DROPPED) {
        double q[IP_NV];
        for (j = 0; j < IP_NV; ++j) {
          q[j] = ip_dot(Z + j * N, v, N) / s;
        }
        for (j = 0; j < N; ++j) {
          const double a = strength * turned[i * N + j];
          g[j] += a * wanted[i];
          for (l = j; l < N; ++l) {
            H[j * N + l] += a * turned[i * N + l] + (l < IP_NV ? weight * x * q[j < IP_NV ? j : 0] * q[l] : 0.0);
          }
        }
      }
    }
    for (i = 0; i < count; ++i) {
      const double *v = B + i * N, s = sqrt(ip_dot(v, v, N)), x = fmin(s / (IP_SINGULAR * c->length[r]), 1.0);
      if (x > IP_DROPPED) {
        ip_remove(Z, v, s, 1.0 - sqrt(1.0 - ip_smooth(x)), N);
      }
    }
  }
}
#endif
