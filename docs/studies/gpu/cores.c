/* Time the batch of an export on all cores, and compare its results with the samples.  run.py defines HEADER, BATCH. */
#include HEADER

#include <math.h>
#include <omp.h>
#include <stdio.h>
#include <stdlib.h>

enum { ROWS = 1 << 16, PART = 256, SECONDS = 2 };

int main(int argc, char **argv)
{
  int sizes[3], k;
  FILE *file = argc == 2 ? fopen(argv[1], "rb") : NULL;
  if (file == NULL || fread(sizes, sizeof(int), 3, file) != 3) {
    return 2;
  }
  const int samples = sizes[0], nq = sizes[1], nv = sizes[2], width = nq + 3 + 1 + nv;
  double *data = malloc(sizeof(double) * samples * width), *q = malloc(sizeof(double) * ROWS * nq);
  double *n = malloc(sizeof(double) * ROWS * 3), *H = malloc(sizeof(double) * ROWS);
  double *grad = malloc(sizeof(double) * ROWS * nv), best = INFINITY, error = 0.0;
  if (fread(data, sizeof(double), (size_t)samples * width, file) != (size_t)samples * width) {
    return 2;
  }
  for (int row = 0; row < ROWS; ++row) {
    const double *sample = data + (size_t)(row % samples) * width;
    for (k = 0; k < nq; ++k) {
      q[(size_t)row * nq + k] = sample[k];
    }
    for (k = 0; k < 3; ++k) {
      n[3 * row + k] = sample[nq + k];
    }
  }
  /* The first rounds touch the memory and wake the cores.  A shared machine can stop a core for several milliseconds. */
  for (double began, end = omp_get_wtime() + SECONDS; (began = omp_get_wtime()) < end;) {
    #pragma omp parallel for schedule(dynamic, 1)
    for (int part = 0; part < ROWS / PART; ++part) {
      const size_t row = (size_t)part * PART;
      BATCH(q + row * nq, n + row * 3, PART, H + row, grad + row * nv);
    }
    best = fmin(best, omp_get_wtime() - began);
  }
  for (int row = 0; row < ROWS; ++row) {
    const double expected = data[(size_t)(row % samples) * width + nq + 3];
    error = fmax(error, fabs(H[row] - expected) / fabs(expected));
  }
  printf("{\"cores\": %d, \"million\": %.2f, \"error_H\": %.1e}\n", omp_get_max_threads(), ROWS / best / 1e6, error);
  return 0;
}
