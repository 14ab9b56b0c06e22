// Two observations beside each other: the first half of the tokens is one's, the second half the other's, and so it is
// with the prefix's rows, which lie one behind the other in the cache. All tokens are multiplied with all keys; those of
// the other observation get no weight. (alone.cu has the same for one.)

#define OF_PAIR(...) __VA_ARGS__
#define PREFIX_ROWS(a) prefix_rows(a)
#define FIRST_ROW(a) +size_t(first_row(a)) * HD
#define POSITION(a, prefix, token) position_of(a, prefix, token)

constexpr int PAIRED = T / 2;  // tokens of one observation
static_assert(T % 2 == 0 && MANY, "a pair's tokens");

__device__ __forceinline__ int first_row(const Args& a) { return __ldg(a.segments); }
__device__ __forceinline__ int border(const Args& a) { return __ldg(a.segments + 1) - first_row(a); }
__device__ __forceinline__ int prefix_rows(const Args& a) { return __ldg(a.segments + 2) - first_row(a); }
// Of a token in its own observation's sequence; `prefix`: rows of both.
__device__ __forceinline__ int position_of(const Args& a, int prefix, int token) {
  return token < PAIRED ? border(a) + token : prefix - border(a) + token - PAIRED;
}

// Which of some rows of keys a token sees: those of its own observation.
struct Mask {
  int second;  // the first of these rows that is the second observation's
  static __device__ __forceinline__ Mask of_prefix(const Cta& b, int tile) { return {border(b.a) - tile * 16}; }
  static __device__ __forceinline__ Mask of_suffix(int first) { return {PAIRED - first}; }
  __device__ __forceinline__ bool sees(int row, int token) const { return (row >= second) == (token >= PAIRED); }
};
