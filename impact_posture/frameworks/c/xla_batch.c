/*
 * Call the batch functions of an export from programs that XLA compiles.
 *
 * Arguments and results of a call are arrays of double or float, whose last axis is a row, and other axes are a batch:
 * q, then n if the function has a normal; value, gradient.  Attributes of a call, sorted by name as XLA sorts them:
 *   function  address of <stem>_eval_batch or <stem>_objective_batch
 *   single    whether this function computes in float
 */
#include <stdatomic.h>
#include <stdlib.h>

#include "xla/ffi/api/c_api.h"

/* Number of rows that a thread computes between two looks at the number of rows that are left. */
enum { ROWS = 256 };

typedef struct {
  intptr_t function;
  int single, other_type;
  int64_t count;
  /* q, n, value and gradient: array, entries per row, and bytes per entry. */
  char *data[4];
  int64_t width[4], size;
  atomic_llong next;
  atomic_int threads, running;
  const XLA_FFI_Api *api;
  XLA_FFI_Future *future;
} Work;

static int64_t scratch_size(const Work *work)
{
  const int64_t row = work->width[0] + work->width[1] + work->width[2] + work->width[3];
  return work->other_type ? ROWS * row * (int64_t)sizeof(double) : 0;
}

/* Convert double to float, or float to double. */
static void convert(void *to, const void *from, int to_single, int64_t count)
{
  int64_t i;
  for (i = 0; i < count; ++i) {
    if (to_single) {
      ((float *)to)[i] = (float)((const double *)from)[i];
    } else {
      ((double *)to)[i] = ((const float *)from)[i];
    }
  }
}

static void compute(const Work *work, int64_t first, int rows, char *scratch)
{
  char *given[4], *at[4];
  int k;
  for (k = 0; k < 4; ++k) {
    given[k] = at[k] = work->data[k] + first * work->width[k] * work->size;
    if (work->other_type) {
      at[k] = scratch;
      scratch += rows * work->width[k] * (int64_t)sizeof(double);
      if (k < 2) {
        convert(at[k], given[k], work->single, rows * work->width[k]);
      }
    }
  }
  /* The status is not needed, because rows that cannot be computed are NaN. */
  if (work->width[1] > 0) {
    ((int (*)(void *, void *, int, void *, void *))work->function)(at[0], at[1], rows, at[2], at[3]);
  } else {
    ((int (*)(void *, int, void *, void *))work->function)(at[0], rows, at[2], at[3]);
  }
  for (k = 2; work->other_type && k < 4; ++k) {
    convert(given[k], at[k], !work->single, rows * work->width[k]);
  }
}

/* Compute rows until none is left.  The last thread reports the end and frees the work. */
static void run(void *argument)
{
  Work *work = argument;
  char *scratch = (char *)(work + 1) + atomic_fetch_add(&work->threads, 1) * scratch_size(work);
  int64_t first;
  while ((first = atomic_fetch_add(&work->next, ROWS)) < work->count) {
    compute(work, first, work->count - first < ROWS ? (int)(work->count - first) : ROWS, scratch);
  }
  if (atomic_fetch_sub(&work->running, 1) == 1) {
    if (work->future != NULL) {
      XLA_FFI_Future_SetAvailable_Args end = {XLA_FFI_Future_SetAvailable_Args_STRUCT_SIZE, NULL, work->future};
      work->api->XLA_FFI_Future_SetAvailable(&end);
    }
    free(work);
  }
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

/* Start the work on the threads of XLA. */
static XLA_FFI_Error *start(XLA_FFI_CallFrame *frame, const Work *sizes)
{
  const XLA_FFI_Api *api = frame->api;
  int64_t threads = (sizes->count + ROWS - 1) / ROWS, most = 1;
  XLA_FFI_ThreadPool_NumThreads_Args pool = {XLA_FFI_ThreadPool_NumThreads_Args_STRUCT_SIZE, NULL, frame->ctx, &most};
  XLA_FFI_ThreadPool_Schedule_Args task = {XLA_FFI_ThreadPool_Schedule_Args_STRUCT_SIZE, NULL, frame->ctx, run};
  XLA_FFI_Future_Create_Args future = {XLA_FFI_Future_Create_Args_STRUCT_SIZE};
  Work *work;
  if (threads > 1 && failed(api, api->XLA_FFI_ThreadPool_NumThreads(&pool))) {
    most = 1;
  }
  threads = most < threads ? most : threads;
  threads = threads < 1 ? 1 : threads;
  work = malloc(sizeof(Work) + (size_t)(threads * scratch_size(sizes)));
  if (work == NULL) {
    XLA_FFI_Error_Create_Args error = {
      XLA_FFI_Error_Create_Args_STRUCT_SIZE, NULL, "no memory is left", XLA_FFI_Error_Code_RESOURCE_EXHAUSTED};
    return api->XLA_FFI_Error_Create(&error);
  }
  *work = *sizes;
  if (threads > 1) {
    XLA_FFI_Error *error = api->XLA_FFI_Future_Create(&future);
    if (error != NULL) {
      free(work);
      return error;
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

XLA_FFI_Error *impact_posture_batch(XLA_FFI_CallFrame *frame)
{
  const int64_t normals = frame->args.size - 1;
  Work sizes = {0};
  int64_t k, i;
  if (frame->extension_start != NULL && frame->extension_start->type == XLA_FFI_Extension_Metadata) {
    XLA_FFI_Metadata *metadata = ((XLA_FFI_Metadata_Extension *)frame->extension_start)->metadata;
    metadata->api_version.major_version = XLA_FFI_API_MAJOR;
    metadata->api_version.minor_version = XLA_FFI_API_MINOR;
    return NULL;
  }
  sizes.api = frame->api;
  sizes.function = (intptr_t)*(int64_t *)((XLA_FFI_Scalar *)frame->attrs.attrs[0])->value;
  sizes.single = *(int32_t *)((XLA_FFI_Scalar *)frame->attrs.attrs[1])->value;
  sizes.count = 1;
  for (k = 0; k <= normals + 2; ++k) {
    const XLA_FFI_Buffer *buffer = k <= normals ? frame->args.args[k] : frame->rets.rets[k - normals - 1];
    const int64_t place = k <= normals ? k : k - normals + 1;
    sizes.data[place] = buffer->data;
    sizes.width[place] = place == 2 ? 1 : buffer->dims[buffer->rank - 1];
    for (i = 0; place == 2 && i < buffer->rank; ++i) {
      sizes.count *= buffer->dims[i];
    }
    sizes.size = buffer->dtype == XLA_FFI_DataType_F32 ? sizeof(float) : sizeof(double);
  }
  sizes.other_type = sizes.single != (sizes.size == sizeof(float));
  return start(frame, &sizes);
}
