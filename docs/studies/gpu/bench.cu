// Time the kernel of an export, and compare its results with the samples.  run.py defines HEADER, KERNEL, REAL,
// THREADS, and ROWS (rows of a block).
#include HEADER

#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <vector>

typedef REAL real;

static void check(cudaError_t error)
{
  if (error != cudaSuccess) {
    std::printf("{\"error\": \"%s\"}\n", cudaGetErrorString(error));
    std::exit(1);
  }
}

template <typename T> static T *on_device(const std::vector<T> &values)
{
  T *data;
  check(cudaMalloc(&data, values.size() * sizeof(T)));
  check(cudaMemcpy(data, values.data(), values.size() * sizeof(T), cudaMemcpyHostToDevice));
  return data;
}

// Arguments: file of samples, and number of rows.
int main(int argc, char **argv)
{
  if (argc != 3) {
    return 2;
  }
  const int count = std::atoi(argv[2]);
  int sizes[3];
  std::FILE *file = std::fopen(argv[1], "rb");
  if (file == nullptr || std::fread(sizes, sizeof(int), 3, file) != 3) {
    return 2;
  }
  const size_t samples = sizes[0], nq = sizes[1], nv = sizes[2], width = nq + 3 + 1 + nv;
  std::vector<double> data(samples * width);
  if (std::fread(data.data(), sizeof(double), data.size(), file) != data.size()) {
    return 2;
  }
  std::fclose(file);
  std::vector<real> q(count * nq), n(count * (size_t)3), H(count, NAN), grad(count * nv, NAN);
  for (size_t row = 0; row < (size_t)count; ++row) {
    const double *sample = &data[row % samples * width];
    std::copy(sample, sample + nq, &q[row * nq]);
    std::copy(sample + nq, sample + nq + 3, &n[row * 3]);
  }
  real *dq = on_device(q), *dn = on_device(n), *dH = on_device(H), *dgrad = on_device(grad);
  int *dstatus = on_device(std::vector<int>(count, -1));
  const auto kernel = KERNEL<THREADS>;
  cudaFuncAttributes attributes;
  check(cudaFuncGetAttributes(&attributes, kernel));
  int resident = 0;
  check(cudaOccupancyMaxActiveBlocksPerMultiprocessor(&resident, kernel, THREADS, 0));
  const auto launch = [&](int rows) {
    kernel<<<(rows + ROWS - 1) / ROWS, THREADS>>>(dq, dn, count, rows, dH, dgrad, dstatus);
  };
  cudaEvent_t start, stop;
  check(cudaEventCreate(&start));
  check(cudaEventCreate(&stop));
  std::vector<float> times;
  for (int k = 0; k < 11; ++k) {
    float milliseconds;
    check(cudaEventRecord(start));
    launch(count);
    check(cudaEventRecord(stop));
    check(cudaEventSynchronize(stop));
    check(cudaEventElapsedTime(&milliseconds, start, stop));
    if (k > 0) {
      times.push_back(milliseconds);
    }
  }
  check(cudaGetLastError());
  std::sort(times.begin(), times.end());
  std::vector<int> status(count);
  check(cudaMemcpy(H.data(), dH, count * sizeof(real), cudaMemcpyDeviceToHost));
  check(cudaMemcpy(grad.data(), dgrad, grad.size() * sizeof(real), cudaMemcpyDeviceToHost));
  check(cudaMemcpy(status.data(), dstatus, count * sizeof(int), cudaMemcpyDeviceToHost));
  double error_H = 0.0, error_grad = 0.0;
  for (size_t row = 0; row < (size_t)count; ++row) {
    const double *sample = &data[row % samples * width + nq + 3];
    double largest = 1e-3 * std::fabs(sample[0]), difference = 0.0;
    for (size_t i = 0; i < nv; ++i) {
      const double one = std::fabs(grad[row * nv + i] - sample[1 + i]);
      largest = std::fmax(largest, std::fabs(sample[1 + i]));
      difference = std::isnan(one) ? INFINITY : std::fmax(difference, one);
    }
    const double one = std::fabs(H[row] - sample[0]) / std::fabs(sample[0]);
    error_H = std::isnan(one) || status[row] != 0 ? INFINITY : std::fmax(error_H, one);
    error_grad = std::fmax(error_grad, difference / largest);
  }
  // Time calls with one block: first until each call has finished, then until each call is launched.
  const auto began = std::chrono::steady_clock::now();
  for (int k = 0; k < 200; ++k) {
    launch(THREADS);
    check(cudaDeviceSynchronize());
  }
  const auto middle = std::chrono::steady_clock::now();
  for (int k = 0; k < 200; ++k) {
    launch(THREADS);
  }
  const auto end = std::chrono::steady_clock::now();
  check(cudaDeviceSynchronize());
  const double median = times[times.size() / 2], least = times[0];
  std::printf("{\"million\": %.1f, \"best\": %.1f, \"error_H\": %.1e, \"error_grad\": %.1e, "
    "\"registers\": %d, \"local\": %zu, \"threads\": %d, \"call_us\": %.1f, \"launch_us\": %.1f}\n",
    count / median / 1e3, count / least / 1e3, error_H, error_grad, attributes.numRegs,
    attributes.localSizeBytes, resident * THREADS,
    std::chrono::duration<double, std::micro>(middle - began).count() / 200,
    std::chrono::duration<double, std::micro>(end - middle).count() / 200);
  return 0;
}
