// The C interface, and the choice of the instruction set.
#include <atomic>
#include <cstring>
#include <new>
#include <stdexcept>

#include "api.h"
#include "threads.h"
#include "variants.h"

namespace torchdof {
namespace {

bool has_avx2() {
#if defined(TORCHDOF_HAS_AVX2)
  return __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
#else
  return false;
#endif
}

std::atomic<bool> use_avx2{has_avx2()};

const Variant &chosen() {
#if defined(TORCHDOF_HAS_AVX2)
  if (use_avx2) return avx2::variant;
#endif
  return baseline::variant;
}

template <typename Body>
int32_t guarded(const Body &body) {
  try {
    body();
    return TORCHDOF_OK;
  } catch (const Cancelled &) {
    return TORCHDOF_CANCELLED;
  } catch (const TooBright &) {
    return TORCHDOF_TOO_BRIGHT;
  } catch (const std::bad_alloc &) {
    return TORCHDOF_NO_MEMORY;
  } catch (const std::length_error &) {
    return TORCHDOF_NO_MEMORY;
  }
}

}  // namespace
}  // namespace torchdof

int32_t torchdof_begin(const torchdof_scene *scene, torchdof_job **job) {
  *job = nullptr;
  return torchdof::guarded([&] { *job = torchdof::chosen().begin(*scene); });
}

int64_t torchdof_radii(const torchdof_job *job, const int32_t **steps) {
  *steps = job->radii.data();
  return (int64_t)job->radii.size();
}

int32_t torchdof_finish(torchdof_job *job, const float *const *kernels, const int32_t *halves,
                        const torchdof_field_mask *field_masks, int32_t field_masks_count, float *out) {
  return torchdof::guarded([&] { job->finish({kernels, halves, field_masks, field_masks_count}, out); });
}

void torchdof_free(torchdof_job *job) { delete job; }

int32_t torchdof_repair_edges(const torchdof_map *map, int32_t *changed) {
  return torchdof::guarded([&] { *changed = torchdof::chosen().repair_edges(*map); });
}

int32_t torchdof_coc(const float *depth, int64_t count, float scale, float nearest, float farthest, int32_t threads, float *out) {
  return torchdof::guarded([&] { torchdof::chosen().coc_of_depth(depth, count, scale, nearest, farthest, threads, out); });
}

int32_t torchdof_plan(const float *coc, int32_t maps, int32_t height, int32_t width, double *tolerance, int32_t threads,
                      double *nodes, int32_t capacity, int32_t *count) {
  return torchdof::guarded([&] {
    const std::vector<double> planned = torchdof::chosen().plan(coc, maps, height, width, *tolerance, threads);
    *count = (int32_t)planned.size();
    if (*count <= capacity) memcpy(nodes, planned.data(), planned.size() * sizeof(double));
  });
}

int32_t torchdof_kernels(const torchdof_spots *spots, int32_t threads, float *const *out) {
  return torchdof::guarded([&] { torchdof::chosen().make_kernels(*spots, threads, out); });
}

int32_t torchdof_ends(const float *values, int64_t count, int32_t threads, float *low, float *high) {
  return torchdof::guarded([&] { torchdof::chosen().ends(values, count, threads, low, high); });
}

int32_t torchdof_blend(const torchdof_layers *layers, float *out, const float *gradient, float *const *of_light,
                       float *const *of_place, float *const *of_weight) {
  return torchdof::guarded([&] { torchdof::chosen().blend(*layers, out, gradient, of_light, of_place, of_weight); });
}

int32_t torchdof_farthest(const float *const *maps, int32_t channels, int32_t height, int32_t width, int32_t rows, int32_t columns,
                          int32_t threads, float *out, const float *gradient, float *const *of_maps) {
  return torchdof::guarded([&] {
    torchdof::chosen().farthest(maps, channels, height, width, rows, columns, threads, out, gradient, of_maps);
  });
}

int32_t torchdof_look_behind(const torchdof_level *levels, int32_t count, int32_t channels, const float *coc, int32_t height, int32_t width,
                             int32_t threads, float *out, const float *gradient, float *const *of_levels, float *of_coc) {
  return torchdof::guarded([&] {
    torchdof::chosen().look_behind(levels, count, channels, coc, height, width, threads, out, gradient, of_levels, of_coc);
  });
}

int64_t torchdof_interface(void) {
  return (int64_t)TORCHDOF_REVISION << 32 | (int64_t)sizeof(torchdof_scene) << 16 | (int64_t)(sizeof(torchdof_map) + sizeof(torchdof_layers) + sizeof(torchdof_level));
}

const char *torchdof_instructions(void) { return torchdof::use_avx2 ? "avx2" : "baseline"; }

int32_t torchdof_use(const char *instructions) {
  const bool avx2 = !strcmp(instructions, "avx2");
  if ((avx2 && !torchdof::has_avx2()) || (!avx2 && strcmp(instructions, "baseline"))) return 0;
  torchdof::use_avx2 = avx2;
  return 1;
}
