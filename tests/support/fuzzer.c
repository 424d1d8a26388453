/* Call a program of this folder once for each input of libFuzzer, with the bytes of the input as its numbers.  The
 * program is built with -Dmain=program and with -DINPUTS="N", its first argument. */
#include <stdint.h>
#include <stdlib.h>

extern const uint8_t *fuzzed_bytes;
extern size_t fuzzed_count;
int program(int count, char **arguments);

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
  char name[] = "program", inputs[] = INPUTS;
  char *arguments[] = {name, inputs, NULL};
  fuzzed_bytes = data;
  fuzzed_count = size;
  if (program(2, arguments) != 0) {
    abort();
  }
  return 0;
}
