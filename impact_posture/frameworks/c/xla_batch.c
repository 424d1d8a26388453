/*
 * Call the batch functions and the kernels of an export from programs that XLA compiles.
 *
 * Arguments and results of a call are arrays of the number type of the export, whose last axis is a row, and other
 * axes are a batch: q, then n if the function has a normal; value, gradient.
 */
#include <limits.h>
#include <stdatomic.h>
#include <stdio.h>
#include <stdlib.h>

#include "xla/ffi/api/c_api.h"

/*
 * Attributes of a call, in the order of their names, which is the order of XLA.  The first is for the CPU:
 *   batch    address of <stem>_eval_batch or <stem>_objective_batch
 * The others are for GPUs:
 *   block    threads in a block of the kernel
 *   fault    text: why there are no kernels; empty if there are kernels
 *   kernels  array: the kernel <stem>_eval_kernel or <stem>_objective_kernel (CUfunction) for each GPU
 *   launch   address of cuLaunchKernel
 *   rows     rows that a block computes
 */
enum { BATCH, BLOCK, FAULT, KERNELS, LAUNCH, BLOCK_ROWS };

/* Number of rows that a thread of the CPU computes between two looks at the number of rows that are left. */
enum { ROWS = 256 };

typedef struct {
  intptr_t function;
  int64_t count;
  /* q, n, value and gradient: array, and bytes per row. */
  char *data[4];
  int64_t width[4];
  atomic_llong next;
  atomic_int running;
  const XLA_FFI_Api *api;
  XLA_FFI_Future *future;
} Work;

/* Return whether XLA asks for the version of this code instead of a computation, and answer. */
static int answered(const XLA_FFI_CallFrame *frame, XLA_FFI_Handler_Traits traits)
{
  if (frame->extension_start != NULL && frame->extension_start->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Metadata *metadata = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    metadata->traits = traits;
    return 1;
  }
  return 0;
}

static int64_t number(const XLA_FFI_CallFrame *frame, int attribute)
{
  return *(int64_t *)((XLA_FFI_Scalar *)frame->attrs.attrs[attribute])->value;
}

static Work work_of(const XLA_FFI_CallFrame *frame)
{
  const int64_t normals = frame->args.size - 1;
  Work work = {0};
  int64_t k, i;
  work.api = frame->api;
  work.count = 1;
  for (k = 0; k <= normals + 2; ++k) {
    const XLA_FFI_Buffer *buffer = k <= normals ? frame->args.args[k] : frame->rets.rets[k - normals - 1];
    const int64_t place = k <= normals ? k : k - normals + 1;
    const int64_t size = buffer->dtype == XLA_FFI_DataType_F32 ? sizeof(float) : sizeof(double);
    work.data[place] = buffer->data;
    work.width[place] = place == 2 ? size : size * buffer->dims[buffer->rank - 1];
    for (i = 0; place == 2 && i < buffer->rank; ++i) {
      work.count *= buffer->dims[i];
    }
  }
  return work;
}

static XLA_FFI_Error *error(const XLA_FFI_Api *api, const char *message, XLA_FFI_Error_Code code)
{
  XLA_FFI_Error_Create_Args created = {XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, message, code};
  return api->XLA_FFI_Error_Create(&created);
}

/* Free an error, and return whether there was one. */
static int failed(const XLA_FFI_Api *api, XLA_FFI_Error *error)
{
  if (error != NULL) {
    XLA_FFI_Error_Destroy_Args destroyed = {XLA_FFI_Error_Destroy_Args_STRUCT_SIZE, NULL, error};
    api->XLA_FFI_Error_Destroy(&destroyed);
  }
  return error != NULL;
}

/* ---- on the CPU ------------------------------------------------------------------------------------------------ */

static void compute(const Work *work, int64_t first, int rows)
{
  char *at[4];
  int k;
  for (k = 0; k < 4; ++k) {
    at[k] = work->data[k] + first * work->width[k];
  }
  /* The status is not needed, because rows that cannot be computed are NaN. */
  if (work->width[1] > 0) {
    ((int (*)(void *, void *, int, void *, void *))work->function)(at[0], at[1], rows, at[2], at[3]);
  } else {
    ((int (*)(void *, int, void *, void *))work->function)(at[0], rows, at[2], at[3]);
  }
}

/* Compute rows until none is left.  The last thread reports the end and frees the work. */
static void run(void *argument)
{
  Work *work = argument;
  int64_t first;
  while ((first = atomic_fetch_add(&work->next, ROWS)) < work->count) {
    compute(work, first, work->count - first < ROWS ? (int)(work->count - first) : ROWS);
  }
  if (atomic_fetch_sub(&work->running, 1) == 1) {
    if (work->future != NULL) {
      XLA_FFI_Future_SetAvailable_Args end = {XLA_FFI_Future_SetAvailable_Args_STRUCT_SIZE, NULL, work->future};
      work->api->XLA_FFI_Future_SetAvailable(&end);
    }
    free(work);
  }
}

/* Compute all rows on the threads of XLA. */
XLA_FFI_Error *impact_posture_batch(XLA_FFI_CallFrame *frame)
{
  const XLA_FFI_Api *api = frame->api;
  int64_t threads, most = 1;
  XLA_FFI_ThreadPool_NumThreads_Args pool = {XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE, NULL, frame->ctx, &most};
  XLA_FFI_ThreadPool_Schedule_Args task = {XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE, NULL, frame->ctx, run};
  XLA_FFI_Future_Create_Args future = {XLA_FFI_Future_Create_Args_STRUCT_SIZE};
  Work *work;
  if (answered(frame, 0)) {
    return NULL;
  }
  work = malloc(sizeof(Work));
  if (work == NULL) {
    return error(api, "no memory is left", XLA_FFI_Error_Code_RESOURCE_EXHAUSTED);
  }
  *work = work_of(frame);
  work->function = (intptr_t)number(frame, BATCH);
  threads = (work->count + ROWS - 1) / ROWS;
  if (threads > 1 && failed(api, api->XLA_FFI_ThreadPool_NumThreads(&pool))) {
    most = 1;
  }
  threads = most < threads ? most : threads;
  threads = threads < 1 ? 1 : threads;
  if (threads > 1) {
    XLA_FFI_Error *fault = api->XLA_FFI_Future_Create(&future);
    if (fault != NULL) {
      free(work);
      return fault;
    }
    frame->future = work->future = future.future;
  }
  atomic_init(&work->running, (int)threads);
  for (task.data = work; threads > 0; --threads) {
    if (future.future == NULL || failed(api, api->XLA_FFI_ThreadPool_Schedule(&task))) {
      run(work);
    }
  }
  return NULL;
}

/* ---- on a GPU -------------------------------------------------------------------------------------------------- */

typedef int Launch(
  void *kernel, unsigned grid_x, unsigned grid_y, unsigned grid_z, unsigned block_x, unsigned block_y,
  unsigned block_z, unsigned shared, void *stream, void **arguments, void **extra);

/* Start the kernel on the stream of XLA, and do not wait for its end. */
XLA_FFI_Error *impact_posture_launch(XLA_FFI_CallFrame *frame)
{
  XLA_FFI_Stream_Get_Args stream = {XLA_FFI_Stream_Get_Args_STRUCT_SIZE, NULL, frame->ctx};
  XLA_FFI_DeviceOrdinal_Get_Args device = {XLA_FFI_DeviceOrdinal_Get_Args_STRUCT_SIZE, NULL, frame->ctx};
  const XLA_FFI_ByteSpan *reason;
  XLA_FFI_Error *fault;
  void *arguments[7], *status = NULL;
  int count, k = 0;
  int64_t rows;
  Work work;
  /* Programs may capture the launch in a graph. */
  if (answered(frame, XLA_FFI_HANDLER_TRAITS_COMMAND_BUFFER_COMPATIBLE)) {
    return NULL;
  }
  work = work_of(frame);
  if (work.count == 0) {
    return NULL;
  }
  reason = frame->attrs.attrs[FAULT];
  if (reason->len > 0) {
    char text[512];
    snprintf(text, sizeof text, "%.*s", (int)reason->len, reason->ptr);
    return error(work.api, text, XLA_FFI_Error_Code_FAILED_PRECONDITION);
  }
  if (work.count > INT_MAX) {
    return error(work.api, "a kernel computes at most 2147483647 rows", XLA_FFI_Error_Code_INVALID_ARGUMENT);
  }
  count = (int)work.count;
  fault = work.api->XLA_FFI_Stream_Get(&stream);
  if (fault == NULL) {
    fault = work.api->XLA_FFI_DeviceOrdinal_Get(&device);
  }
  if (fault != NULL) {
    return fault;
  }
  work.function = (intptr_t)((int64_t *)((XLA_FFI_Array *)frame->attrs.attrs[KERNELS])->data)[device.device_ordinal];
  arguments[k++] = &work.data[0];
  if (work.width[1] > 0) {
    arguments[k++] = &work.data[1];
    arguments[k++] = &count;
  }
  arguments[k++] = &count;
  arguments[k++] = &work.data[2];
  arguments[k++] = &work.data[3];
  arguments[k++] = &status;
  rows = number(frame, BLOCK_ROWS);
  if (((Launch *)(intptr_t)number(frame, LAUNCH))(
        (void *)work.function, (unsigned)((work.count + rows - 1) / rows), 1, 1, (unsigned)number(frame, BLOCK), 1, 1,
        0, stream.stream, arguments, NULL) != 0) {
    return error(work.api, "cuLaunchKernel failed", XLA_FFI_Error_Code_INTERNAL);
  }
  return NULL;
}
