// Numbers and comparisons with which the rules of the picture are written: for the compiled engine, with vectors of
// pixels, and for the kernels of GPUs (torchdof/kernels), with single pixels.
#pragma once

namespace torchdof {

// The larger and the smaller of two values; b if a is NaN, other than in std and CUDA.
template <typename V>
inline V max(V a, V b) {
  return a > b ? a : b;
}
template <typename V>
inline V min(V a, V b) {
  return a < b ? a : b;
}
template <typename V>
inline V absolute(V v) {
  return max(v, -v);
}
template <typename V>
inline V sign(V v) {  // 0 of 0
  return v > V{} ? V{} + 1.0f : v < V{} ? V{} - 1.0f : V{};
}
template <typename V>
inline V clamp01(V v) {
  return min(max(v, V{}), V{} + 1.0f);
}
template <>
inline float clamp01(float v) {  // NaN stays NaN
  return v < 0.0f ? 0.0f : v > 1.0f ? 1.0f : v;
}

constexpr float TINY = 1.17549435e-38f;  // the smallest normal number; lower limit where light is the divisor

}  // namespace torchdof
