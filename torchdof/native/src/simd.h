// Vectors of LANES pixels, written with the vector types of GCC and Clang: their operators work lane by lane, and a
// scalar beside a vector is broadcast. Comparisons give an ivec of masks, -1 where they hold; `mask ? a : b` selects.
#pragma once
#include <cstdint>
#include <cstring>

#include "numbers.h"

namespace torchdof {

#if defined(__AVX2__)
constexpr int LANES = 8;
#else
constexpr int LANES = 4;
#endif
typedef float vec __attribute__((vector_size(LANES * 4)));
typedef int32_t ivec __attribute__((vector_size(LANES * 4)));

template <typename V, typename T>
inline V load(const T *p) {
  typedef V unaligned __attribute__((aligned(4)));
  return *(const unaligned *)p;
}
template <typename V, typename T>
inline void store(T *p, V v) {
  typedef V unaligned __attribute__((aligned(4)));
  *(unaligned *)p = v;
}
inline vec broadcast(float v) { return v - vec{}; }
#if defined(__AVX2__)  // compilers do not always find the single instruction
template <>
inline vec max(vec a, vec b) {
  return __builtin_ia32_maxps256(a, b);
}
template <>
inline vec min(vec a, vec b) {
  return __builtin_ia32_minps256(a, b);
}
#endif
inline vec iota() {  // 0, 1, 2, ...
  vec v;
  for (int i = 0; i < LANES; i++) v[i] = i;
  return v;
}
inline ivec convert(vec v) { return __builtin_convertvector(v, ivec); }
inline vec convert(ivec v) { return __builtin_convertvector(v, vec); }
inline float reduce_max(vec v) {
  float m = v[0];
  for (int i = 1; i < LANES; i++) m = v[i] > m ? v[i] : m;
  return m;
}
inline float reduce_min(vec v) { return -reduce_max(-v); }
inline vec abs(vec v) { return (vec)((ivec)v & 0x7fffffff); }
typedef float quad __attribute__((vector_size(16)));
inline float reduce_add(vec v) {
  quad parts[LANES / 4];
  memcpy(parts, &v, sizeof(v));
  for (int i = 1; i < LANES / 4; i++) parts[0] += parts[i];
  return (parts[0][0] + parts[0][2]) + (parts[0][1] + parts[0][3]);
}
// Looks up LANES of eight values by index.
inline vec lookup(const float *values, ivec index) {
#if defined(__AVX2__)
  return (vec)__builtin_ia32_permvarsf256(load<vec>(values), index);
#else
  vec picked;
  for (int i = 0; i < LANES; i++) picked[i] = values[index[i]];
  return picked;
#endif
}
// Packs the sign bit of each lane.
#if defined(__AVX2__)
inline int movemask(ivec mask) { return __builtin_ia32_movmskps256((vec)mask); }
inline bool any_of(ivec mask) { return movemask(mask) != 0; }
#else
inline int movemask(ivec mask) {
  int lanes = 0;
  for (int i = 0; i < LANES; i++) lanes |= (mask[i] & 1) << i;
  return lanes;
}
inline bool any_of(ivec mask) {
  typedef long long wide __attribute__((vector_size(LANES * 4)));
  return (((wide)mask)[0] | ((wide)mask)[1]) != 0;
}
#endif
inline bool any_positive(vec v) { return any_of(v > vec{}); }

}  // namespace torchdof
