// The matting of torchdof.render.surfaces.matting on a GPU, forward and backward; its docstrings have the formulas. NVRTC compiles
// this file at first use, with the number CHANNELS defined. Without shared memory, barriers and atomic operations, as layers.cu.
//
//   find_edges   the certainty of each pixel that it lies at an edge, from the coc of the 3 x 3 pixels around
//   find_clean   its light without that of the other surface, from light, coc and certainty of those pixels
//   split        both surfaces of the pixels at an edge, from all of these
//
// Each step has a `_back`. There a pixel at an edge writes the parts of the gradients by the values of its 3 x 3 pixels,
// and `gather` adds up the parts that concern a pixel. So each sum has a fixed order. Gradients of x are named of_x.
#include "matting.h"
#include "split.h"

extern "C" __global__ void find_edges(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const float apart = counts(r, p) > 0 ? ends_of(r, p).apart() : 0.0f;
  r.edge[p.in(r, 1, 0)] = apart > EDGE_PX ? torchdof::min(apart / EDGE_PX - 1, 1.0f) : 0.0f;
}

extern "C" __global__ void find_clean(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  if (edge_of(r, p) > 0) {
    const Same s = same_surface(r, p);
    EACH_CHANNEL {
      const float light = light_of(r, p, c), step = s.mean[c] - light;  // as torch.lerp, exact at both ends
      r.clean[p.in(r, CHANNELS, c)] = s.taken() < 0.5f ? light + s.taken() * step : s.mean[c] - step * (1 - s.taken());
    }
  } else {
    EACH_CHANNEL r.clean[p.in(r, CHANNELS, c)] = light_of(r, p, c);
  }
}

extern "C" __global__ void split(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  if (!(r.edge[p.in(r, 1, 0)] > 0)) {
    EACH_CHANNEL {
      r.surfaces[p.in(r, PLANES, c)] = r.light[p.in(r, CHANNELS, c)];
      r.surfaces[p.in(r, PLANES, OTHER + c)] = 0;
    }
    r.surfaces[p.in(r, PLANES, COC)] = r.coc[p.in(r, 1, 0)];
    r.surfaces[p.in(r, PLANES, WEIGHT)] = 0;
    return;
  }
  const Split s = split_of(r, p);
  EACH_CHANNEL {
    const Moved m = moved_of(r, p, s, c);
    r.surfaces[p.in(r, PLANES, c)] = s.mixed.own_light(m) * s.scale;
    r.surfaces[p.in(r, PLANES, OTHER + c)] = s.mixed.other_light(m) * s.scale;
  }
  r.surfaces[p.in(r, PLANES, COC)] = s.mixed.by_owner(s.ends.far, s.ends.near);
  r.surfaces[p.in(r, PLANES, WEIGHT)] = s.mixed.weight;
}

// The parts of the gradients that a pixel at an edge writes.
struct Parts {
  float *first;
  int count;
  __device__ Parts(const Run &r, const Pixel &p) : first(r.parts + r.slots[p.in(r, 1, 0)] - 1), count(r.count) {}
  __device__ float &at(int value, int i) const { return first[(long long)(value * TAPS + i) * count]; }
  __device__ float &of_end(int end) const { return first[(long long)(OF_ENDS + end) * count]; }
  // Shares the gradients by the nearest and the farthest coc among the pixels around that have them.
  __device__ void add_ends(const Run &r, const Pixel &p, const Ends &e, float of_near, float of_far) const {
    float nearest = 0, farthest = 0;
    for (int pass = 0; pass < 2; pass++) {
      TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
        const Pixel q = around(r, p, i);
        const bool is_near = counts(r, q) > 0 && coc_of(r, q) == e.near, is_far = counts(r, q) > 0 && coc_of(r, q) == e.far;
        if (pass)
          at(OF_COC, i) += (is_near ? of_near / nearest : 0.0f) + (is_far ? of_far / farthest : 0.0f);
        else
          nearest += is_near, farthest += is_far;
      }
    }
  }
};

// Steps 5 to 3 back: the gradients by the mean colours, and by the pixel's own light, `middle`.
struct OfSplit {
  torchdof::OfMixedPixel<float> by;
  float near[CHANNELS], far[CHANNELS], middle[CHANNELS];
};
__device__ inline OfSplit split_back_of(const Run &r, const Pixel &p, const Split &s, const Parts &parts) {
  OfSplit of = {};
  of.by.weight = r.of_surfaces[p.in(r, PLANES, WEIGHT)];
  EACH_CHANNEL {
    const float of_own = r.of_surfaces[p.in(r, PLANES, c)] * s.scale, of_other = r.of_surfaces[p.in(r, PLANES, OTHER + c)] * s.scale;
    const auto ends = s.mixed.back_of_moved(moved_of(r, p, s, c), of_own, of_other, of.by, of.middle[c], of.near[c], of.far[c]);
    const int end = p.item * CHANNELS + c;
    parts.of_end(c) = absolute(r.darkest[end] / s.scale) <= UNBOUNDED ? ends.darkest * s.per_scale : 0.0f;
    parts.of_end(CHANNELS + c) = absolute(r.brightest[end] / s.scale) <= UNBOUNDED ? ends.brightest * s.per_scale : 0.0f;
  }
  s.mixed.back_of_weight(s.own_light, s.seen.near, s.seen.far, r.of_surfaces[p.in(r, PLANES, COC)], of.by, of.middle, of.near, of.far);
  return of;
}

// The parts of the gradients by light, coc, certainty and clean light around. Elsewhere than at edges the surfaces are the values.
extern "C" __global__ void __launch_bounds__(TILE_ROWS * TILE_COLUMNS) split_back(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  if (!(edge_of(r, p) > 0)) {
    EACH_CHANNEL r.of_values[p.in(r, VALUES, c)] += r.of_surfaces[p.in(r, PLANES, c)];
    r.of_values[p.in(r, VALUES, OF_COC)] += r.of_surfaces[p.in(r, PLANES, COC)];
    return;
  }
  const Split s = split_of(r, p);
  const Parts parts(r, p);
  OfSplit of = split_back_of(r, p, s, parts);

  // Step 2 back. seen = light - limited contrast, share = per_strength sum((light - clean) contrast), of the clean colours
  float of_contrast[CHANNELS] = {}, of_strength = 0;
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Neighbour n = s.neighbour(r, p, i);
    const Light l = s.light(r, n);
    float of_nearer = -of.by.variance * s.seen.near_variance / s.total_nearer, of_share = 0;
    float of_farther = -of.by.variance * s.seen.far_variance / s.total_farther;
    EACH_CHANNEL {
      const float seen = l.value[c] - l.limited * s.clean.contrast(c);
      const float of_seen = s.colours_back(s.seen, c, n, seen, of.near[c], of.far[c], of.by.variance, of_nearer, of_farther);
      of_share -= of_seen * s.clean.contrast(c);
      of_contrast[c] -= of_seen * l.limited;
      parts.at(c, i) = of_seen;
    }
    of_share = within(n.nearer > n.farther ? -l.share : l.share) ? of_share * s.per_strength : 0.0f;
    of_strength -= of_share * l.share;
    EACH_CHANNEL of_contrast[c] += of_share * (l.value[c] - l.clean[c]);
    parts.at(OF_CLEAN, i) = of_share;  // for the next loop, as these two
    parts.at(OF_EDGE, i) = of_nearer;
    parts.at(OF_COC, i) = of_farther;
  }
  EACH_CHANNEL of_contrast[c] += 2 * of_strength * s.clean.contrast(c);
  const float of_variance = TEXTURE * of_strength;
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Neighbour n = s.neighbour(r, p, i);
    const Light l = s.light(r, n);
    const float of_share = parts.at(OF_CLEAN, i);
    float of_nearer = parts.at(OF_EDGE, i) - of_variance * s.clean.near_variance / s.total_nearer;
    float of_farther = parts.at(OF_COC, i) - of_variance * s.clean.far_variance / s.total_farther;
    EACH_CHANNEL {
      const float of_off = of_share * s.clean.contrast(c);
      const float of_clean = s.colours_back(s.clean, c, n, l.clean[c], of_contrast[c], -of_contrast[c], of_variance, of_nearer, of_farther) - of_off;
      const float of_light = parts.at(c, i) + of_off + (i == MIDDLE ? of.middle[c] : 0.0f);
      parts.at(c, i) = of_light * s.per_scale;
      parts.at(OF_CLEAN + c, i) = absolute(r.clean[n.pixel.in(r, CHANNELS, c)] * s.per_scale) <= MOST_CLEAN ? of_clean * s.per_scale : 0.0f;
    }
    const float near = torchdof::unlimited_on_near(n.nearness), far = torchdof::unlimited_on_far(n.nearness), valid = counts(r, n.pixel);
    const float of_sides = (within(near) ? of_nearer : 0.0f) - (within(far) ? of_farther : 0.0f);
    const float of_nearness = (PLACE_SLOPE * n.unmixed * of_sides + of.by.covered * falloff(i, SOFTNESS_FALLOFF) * valid * s.per_counted) / s.mixed.gap;
    of.by.far_px += of_nearness;
    of.by.gap -= of_nearness * n.nearness;
    parts.at(OF_EDGE, i) = (i == MIDDLE ? of.by.edge : 0.0f) - falloff(i, FALLOFF) * valid * (of_nearer * clamp01(near) + of_farther * clamp01(far));
    parts.at(OF_COC, i) = (i == MIDDLE ? of.by.coc : 0.0f) - of_nearness;
  }
  parts.add_ends(r, p, s.ends, of.by.near_px - of.by.gap, of.by.far_px + of.by.gap);
}

// Adds the parts of the gradients by `planes` values of a pixel. A pixel of the border is around others, and itself, several times.
extern "C" __global__ void gather(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const bool is_border = p.y == 0 || p.x == 0 || p.y == r.height - 1 || p.x == r.width - 1;
  float sum[VALUES] = {};
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Pixel q = around(r, p, i);
    if (q.y != p.y + i / 3 - 1 || q.x != p.x + i % 3 - 1 || !(edge_of(r, q) > 0)) continue;
    const Parts parts(r, q);
    const int opposite = TAPS - 1 - i;
    TAP_BY_TAP for (int j = is_border ? 0 : opposite; j <= (is_border ? TAPS - 1 : opposite); j++) {
      const Pixel o = around(r, q, j);
      if (o.y != p.y || o.x != p.x) continue;
      EACH_VALUE if (n < r.planes) sum[n] += parts.at(r.first + n, j);
    }
  }
  EACH_VALUE if (n < r.planes) r.of_values[p.in(r, VALUES, r.first + n)] += sum[n];
}

// The parts of the gradients by light, coc and certainty around, from that by the clean light.
extern "C" __global__ void find_clean_back(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  if (!(edge_of(r, p) > 0)) {
    EACH_CHANNEL r.of_values[p.in(r, VALUES, c)] += r.of_values[p.in(r, VALUES, OF_CLEAN + c)];
    return;
  }
  const Same s = same_surface(r, p);
  const Parts parts(r, p);
  float of_clean[CHANNELS], of_taken = 0, of_coc = 0;
  EACH_CHANNEL {
    of_clean[c] = r.of_values[p.in(r, VALUES, OF_CLEAN + c)];
    of_taken += of_clean[c] * (s.mean[c] - light_of(r, p, c));
  }
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Pixel q = around(r, p, i);
    const float apart = s.apart(r, q), alike = s.alike(apart), weight = s.weight(r, q, i);
    float of_weight = within(s.enough) ? of_taken * s.edge : 0.0f;
    EACH_CHANNEL {
      const float of_mean = of_clean[c] * s.taken() / s.total;
      of_weight += of_mean * (light_of(r, q, c) - s.mean[c]);
      parts.at(c, i) = of_mean * weight + (i == MIDDLE ? of_clean[c] - of_clean[c] * s.taken() : 0.0f);
    }
    const float of_apart = within(alike) ? -2 * sign(apart) * of_weight * unmixed(r, q, i) / EDGE_PX : 0.0f;
    parts.at(OF_EDGE, i) = (i == MIDDLE ? of_taken * clamp01(s.enough) : 0.0f) - of_weight * clamp01(alike) * falloff(i, FALLOFF) * counts(r, q);
    parts.at(OF_COC, i) = of_apart;
    of_coc -= of_apart;
  }
  parts.at(OF_COC, MIDDLE) += of_coc;
}

// The parts of the gradients by the coc around, from that by the certainty; and the gradients by the range of the light, shared among
// the pixels that have the darkest or the brightest light.
extern "C" __global__ void find_edges_back(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  EACH_CHANNEL {
    const float *const of_ends = r.of_ends + p.item * 4 * CHANNELS + c;
    float sum = 0;
    if (light_of(r, p, c) == r.darkest[p.item * CHANNELS + c]) sum += of_ends[0] / of_ends[2 * CHANNELS];
    if (light_of(r, p, c) == r.brightest[p.item * CHANNELS + c]) sum += of_ends[CHANNELS] / of_ends[3 * CHANNELS];
    r.of_values[p.in(r, VALUES, c)] += sum;
  }
  if (!(edge_of(r, p) > 0)) return;
  const Ends e = ends_of(r, p);
  const float slope = within(e.apart() / EDGE_PX - 1) ? r.of_values[p.in(r, VALUES, OF_EDGE)] / EDGE_PX : 0.0f;
  // the smaller of both blurs is that of one surface, or of both by halves
  const float near = absolute(e.near), far = absolute(e.far), of_blur = -torchdof::SAME_BLUR * slope * (near == far ? 0.5f : 1.0f);
  const Parts parts(r, p);
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) parts.at(OF_COC, i) = 0;
  parts.add_ends(r, p, e, (near <= far ? of_blur * sign(e.near) : 0.0f) - slope, (far <= near ? of_blur * sign(e.far) : 0.0f) + slope);
}

// Sums over the pixels of a row: the gradients by the darkest and the brightest light, then how many pixels have it. One thread a row.
extern "C" __global__ void sum_rows(const __grid_constant__ Run r) {
  Pixel p;
  p.y = blockIdx.x * TILE_COLUMNS + threadIdx.x;
  if (p.y >= r.height) return;
  const int c = blockIdx.y;
  float sums[4] = {};
  for (p.x = 0; p.x < r.width; p.x++) {
    sums[2] += light_of(r, p, c) == r.darkest[p.item * CHANNELS + c];
    sums[3] += light_of(r, p, c) == r.brightest[p.item * CHANNELS + c];
    if (!(edge_of(r, p) > 0)) continue;
    const float *const ends = r.parts + (long long)(OF_ENDS + c) * r.count + r.slots[p.in(r, 1, 0)] - 1;
    sums[0] += ends[0];
    sums[1] += ends[(long long)CHANNELS * r.count];
  }
  for (int n = 0; n < 4; n++) r.of_rows[((long long)(p.item * 4 + n) * CHANNELS + c) * r.height + p.y] = sums[n];
}
