// Prepares a scene: cleaned copies, second surfaces, highlights.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <utility>
#include <vector>

#include "api.h"
#include "blocks.h"
#include "blur_axis.h"
#include "composite.h"
#include "constants/checksum.h"
#include "constants/exposure.h"
#include "disocclusion.h"
#include "entry.h"
#include "extremes.h"
#include "field_mask.h"
#include "job.h"
#include "layers.h"
#include "simd.h"
#include "threads.h"

namespace torchdof {

Job::Job(const torchdof_scene &scene)
    : scene(scene), height(scene.height), width(scene.width), channels(scene.channels), colours(scene.kernel_colours) {
  const float *values = scene.kernels;
  for (int k = 0; k < scene.layers; k++) {
    Layer l = make_layer(scene.nodes, scene.layers, k);
    l.scale = scene.scales[k];
    l.half = scene.halves[k];
    const int side = 2 * l.half + 1;
    for (int e = 0; e < colours; e++, values += side * side)
      l.kernels.push_back(make_kernel(values, l.half, !scene.field_masks));
    if (scene.field_masks && l.half) {
      l.field_mask = scene.field_masks + k;
      l.spots = ends_dark(*l.field_mask, scene.distances);
    }
    layers.push_back(std::move(l));
  }
}

void ends_of(const float *values, int width, int rows, float *low, float *high) {
  const int blocks = ceil_div(width, BLOCK);
  std::vector<float> lows((size_t)blocks * LANES, INFINITY), highs(lows.size(), -INFINITY);
  for (int y = 0; y < rows; y++, values += width)
    for (int i = 0; i < blocks; i++) {
      const float *of_block = values + i * BLOCK;
      float *const its_lows = &lows[i * LANES], *const its_highs = &highs[i * LANES];
      if ((i + 1) * BLOCK <= width)
        for (int x = 0; x < BLOCK; x += LANES) {
          store(its_lows, min(load<vec>(of_block + x), load<vec>(its_lows)));
          store(its_highs, max(load<vec>(of_block + x), load<vec>(its_highs)));
        }
      else
        for (int x = 0; x < width - i * BLOCK; x++) {
          *its_lows = std::min(*its_lows, of_block[x]);
          *its_highs = std::max(*its_highs, of_block[x]);
        }
    }
  for (int i = 0; i < blocks; i++) {
    low[i] = reduce_min(load<vec>(&lows[i * LANES]));
    high[i] = reduce_max(load<vec>(&highs[i * LANES]));
  }
}

// Takes the inputs.
void Job::take_scene() {
  surfaces.height = height;
  surfaces.width = width;
  surfaces.channels = channels;
  surfaces.count = 1;
  surfaces.block_rows = ceil_div(height, BLOCK);
  surfaces.block_columns = ceil_div(width, BLOCK);
  surfaces.blocks.resize((size_t)surfaces.block_rows * surfaces.block_columns);
  surfaces.light = scene.light[0];
  surfaces.coc = scene.coc[0];
  if (scene.kind == TORCHDOF_STACK) {
    surfaces.count = scene.surfaces;
    surfaces.independent = true;
    for (int i = 0; i < scene.surfaces; i++) {
      surfaces.lights.push_back(scene.light[i]);
      surfaces.cocs.push_back(scene.coc[i]);
      surfaces.weights.push_back(scene.weight[i]);
    }
    return;
  }
  clean_inputs();
  find_extremes();
  if (surfaces.valid) copy_masked_blocks();
}

// Replaces values that are not finite by 0, in copies, and marks their pixels. Clamps coc to the range of the layers.
void Job::clean_inputs() {
  const size_t area = surfaces.area();
  const float low = coc_at(layers.front().node), high = coc_at(layers.back().node);
  float nearest, farthest, darkest = 0, brightest = 0;
  find_ends(surfaces.coc, area, scene.threads, &nearest, &farthest);
  if (scene.masked) find_ends(surfaces.light, area * channels, scene.threads, &darkest, &brightest);
  const auto is_finite = [](float least, float most) { return std::isfinite(least) && std::isfinite(most); };
  const bool bad = scene.masked && !(is_finite(nearest, farthest) && is_finite(darkest, brightest));
  if (!bad && nearest >= low && farthest <= high) return;
  clean_coc = Buffer<float>(area);
  clean_light = Buffer<float>(bad ? area * channels : 0);
  validity = Buffer<float>(bad ? area : 0);
  parallel(height, [&](int y, int) {
    for (size_t i = surfaces.pixel(y, 0); i < surfaces.pixel(y + 1, 0); i++) {
      bool valid = true;
      if (bad) {
        valid = std::isfinite(surfaces.coc[i]);
        for (int c = 0; c < channels; c++) valid &= std::isfinite(surfaces.light[c * area + i]);
        for (int c = 0; c < channels; c++) clean_light[c * area + i] = valid ? surfaces.light[c * area + i] : 0.0f;
        validity[i] = valid;
      }
      clean_coc[i] = valid ? std::clamp(surfaces.coc[i], low, high) : 0.0f;
    }
  });
  surfaces.coc = clean_coc.data();
  if (bad) surfaces.light = clean_light.data(), surfaces.valid = validity.data();
}

// Finds the extremes of coc and light in each block and in the frame; refuses light whose powers would overflow.
void Job::find_extremes() {
  const size_t area = surfaces.area();
  for (auto *extremes : {&block_low, &block_high, &block_peak}) *extremes = Buffer<float>(surfaces.blocks.size());
  std::vector<float> leasts((size_t)channels * surfaces.block_rows, INFINITY), mosts(leasts.size(), -INFINITY);
  parallel(surfaces.block_rows, [&](int by, int) {
    const size_t first = (size_t)by * surfaces.block_columns, start = (size_t)by * BLOCK * width;
    const int rows = std::min(BLOCK, height - by * BLOCK);
    ends_of(surfaces.coc + start, width, rows, &block_low[first], &block_high[first]);
    float *const peaks = &block_peak[first];
    std::vector<float> lows(surfaces.block_columns), highs(surfaces.block_columns);
    for (int c = 0; c < channels; c++) {
      ends_of(surfaces.light + c * area + start, width, rows, lows.data(), highs.data());
      for (int i = 0; i < surfaces.block_columns; i++) peaks[i] = c ? std::max(peaks[i], highs[i]) : highs[i];
      leasts[by * channels + c] = *std::min_element(lows.begin(), lows.end());
      mosts[by * channels + c] = *std::max_element(highs.begin(), highs.end());
    }
  });
  light_least.assign(channels, INFINITY);
  light_most.assign(channels, -INFINITY);
  for (size_t i = 0; i < leasts.size(); i++) {
    light_least[i % channels] = std::min(light_least[i % channels], leasts[i]);
    light_most[i % channels] = std::max(light_most[i % channels], mosts[i]);
  }
  // fourth powers are summed
  constexpr float BRIGHTEST = 1 << (std::numeric_limits<float>::max_exponent - constants::exposure::SUMMED) / 4;
  for (int c = 0; c < channels; c++)
    if (std::max(light_most[c], -light_least[c]) > BRIGHTEST) throw TooBright();
}

// Copies the blocks with marked pixels, where these get the weight 0.
void Job::copy_masked_blocks() {
  for (int i = 0; i < (int)surfaces.blocks.size(); i++) {
    bool whole = true;
    const int y0 = i / surfaces.block_columns * BLOCK, x0 = i % surfaces.block_columns * BLOCK;
    for (int y = y0; y < std::min(height, y0 + BLOCK); y++)
      for (int x = x0; x < std::min(width, x0 + BLOCK); x++) whole &= surfaces.valid[surfaces.pixel(y, x)] > 0;
    if (!whole) surfaces.make_block(i);
  }
}

void find_ends(const float *values, int64_t count, int threads, float *low, float *high) {
  constexpr int64_t PART = 1 << 16;
  const int parts = (int)((count + PART - 1) / PART);
  std::vector<float> lows(parts), highs(parts);
  torchdof::parallel(threads, parts, nullptr, [&](int part, int) {
    const float *const its_values = values + part * PART;
    const int its_count = (int)std::min(PART, count - part * PART), whole = its_count / LANES * LANES;
    vec its_lows = broadcast(INFINITY), its_highs = broadcast(-INFINITY), any_nan = {};
    const auto look = [&](vec v) {
      its_lows = min(v, its_lows);
      its_highs = max(v, its_highs);
      any_nan = v == v ? any_nan : broadcast(1.0f);
    };
    for (int i = 0; i < whole; i += LANES) look(load<vec>(its_values + i));
    for (int i = whole; i < its_count; i++) look(broadcast(its_values[i]));
    lows[part] = any_positive(any_nan) ? NAN : reduce_min(its_lows);
    highs[part] = any_positive(any_nan) ? NAN : reduce_max(its_highs);
  });
  *low = INFINITY;
  *high = -INFINITY;
  for (int part = 0; part < parts; part++) {
    if (std::isnan(lows[part])) {
      *low = *high = NAN;
      return;
    }
    *low = std::min(*low, lows[part]);
    *high = std::max(*high, highs[part]);
  }
}

void Job::begin() {
  take_scene();
  if (scene.kind == TORCHDOF_STACK) return;
  const bool several = layers.size() > 1 || scene.field_masks, background = scene.kind == TORCHDOF_BACKGROUND;
  const float reach = std::max(std::fabs(coc_at(layers.front().node)), std::fabs(coc_at(layers.back().node)));
  // without occlusion, highlights need rays only where coarse layers would blur their outlines
  const bool limited = several && (scene.occlusion || (scene.highlights && scene.crisp_px < reach));
  if (limited || scene.occlusion || scene.normalize) find_threshold();
  if (background) {
    surfaces.count = 2;
    split_mixed();
    add_background();
  } else if (limited && scene.occlusion) {
    surfaces.count = 2;
    split_mixed();
    levels = std::min((int)std::ceil(std::log2(std::max(2.0, (double)reach))) + 1, MOST_LEVELS);
    fill_hidden();
  }
  if (limited && scene.highlights) extract_highlights();
}

}  // namespace torchdof

struct torchdof_job : torchdof::Job {
  using Job::Job;
};

int32_t torchdof_begin(const torchdof_scene *scene, torchdof_job **job) {
  *job = nullptr;
  return torchdof::guarded([&] {
    auto begun = std::make_unique<torchdof_job>(*scene);
    begun->begin();
    *job = begun.release();
  });
}

int64_t torchdof_radii(const torchdof_job *job, const int32_t **steps) {
  *steps = job->radii.data();
  return (int64_t)job->radii.size();
}

int32_t torchdof_finish(torchdof_job *job, const float *const *kernels, const int32_t *halves,
                        const torchdof_field_mask *field_masks, int32_t field_masks_count, float *out) {
  return torchdof::guarded([&] { torchdof::composite(*job, {kernels, halves, field_masks, field_masks_count}, out); });
}

void torchdof_free(torchdof_job *job) { delete job; }

int32_t torchdof_ends(const float *values, int64_t count, int32_t threads, float *low, float *high) {
  return torchdof::guarded([&] { torchdof::find_ends(values, count, threads, low, high); });
}

int64_t torchdof_interface(void) { return torchdof::constants::checksum::INTERFACE; }

int64_t torchdof_constants(void) { return torchdof::constants::checksum::ALL; }
