/* Numbers from 0 to 1 for programs that test exported C.  fuzzer.c provides bytes of libFuzzer; without bytes, a
 * generator provides the numbers from the seed of the thread. */
#include <stddef.h>
#include <stdint.h>

const uint8_t *fuzzed_bytes;
size_t fuzzed_count;
static __thread uint64_t seed = 1;

static double number(void)
{
  if (fuzzed_count >= 2) {
    const unsigned both = fuzzed_bytes[0] * 256u + fuzzed_bytes[1];
    fuzzed_bytes += 2;
    fuzzed_count -= 2;
    return both / 65536.0;
  }
  seed = seed * 6364136223846793005u + 1442695040888963407u;
  return (double)(seed >> 11) / 9007199254740992.0;
}

static int draw(int count)
{
  return (int)(number() * count);
}
