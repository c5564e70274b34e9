// The matting of torchdof.render.surfaces.matting on a GPU, forward and backward; its docstrings have the formulas. NVRTC compiles
// this file at first use, with the number CHANNELS defined. Without shared memory, barriers and atomic operations, as layers.cu.
//
//   find_edges   the certainty of each pixel that it lies at an edge, from the coc of the 3 x 3 pixels around
//   find_clean   its light without that of the other surface, from light, coc and certainty of those pixels
//   split        both surfaces of the pixels at an edge, from all of these
//   cover        the surfaces of a matte, where there is one
//
// Each step but the last has a `_back`. There a pixel at an edge writes the parts of the gradients by the values of its 3 x 3 pixels,
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
    const float moved = torchdof::min(m.steps[3], s.weight * m.most);
    r.surfaces[p.in(r, PLANES, c)] = (m.light - moved) / (1 - s.weight) * s.scale;
    r.surfaces[p.in(r, PLANES, OTHER + c)] = s.weight > 0 ? moved / torchdof::max(s.weight, LEAST) * s.scale : 0.0f;
  }
  r.surfaces[p.in(r, PLANES, COC)] = s.by_owner(s.ends.far, s.ends.near);
  r.surfaces[p.in(r, PLANES, WEIGHT)] = s.weight;
}

// The surfaces of a pixel by a matte, from those of `split`: the certainty that they are known, weights of the other surface in the one
// and the other, and both.
struct Cover {
  float certainty, kept, given, both, known;
};
__device__ inline Cover cover_of(const Run &r, const Pixel &p) {
  Cover v;
  v.certainty = r.covered[p.in(r, CHANNELS + 3, CHANNELS + 2)];
  v.kept = (1 - v.certainty) * r.surfaces[p.in(r, PLANES, WEIGHT)];
  v.given = v.certainty * r.covered[p.in(r, CHANNELS + 3, CHANNELS + 1)];
  v.both = v.kept + v.given;
  v.known = torchdof::max(v.both, LEAST);
  return v;
}
// Its other light, of a channel, and coc.
__device__ inline float covered_light(const Run &r, const Pixel &p, const Cover &v, int c) {
  const float given = v.certainty * r.covered[p.in(r, CHANNELS + 3, c)] * r.light[p.in(r, CHANNELS, c)];
  return v.both > 0 ? (v.kept * r.surfaces[p.in(r, PLANES, OTHER + c)] + given) / v.known : 0.0f;
}
__device__ inline float covered_coc(const Run &r, const Pixel &p, const Cover &v) {
  const float coc = r.surfaces[p.in(r, PLANES, COC)];
  return v.both > 0 ? (v.kept * coc + v.given * r.covered[p.in(r, CHANNELS + 3, CHANNELS)]) / v.known : coc;
}

extern "C" __global__ void cover(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const Cover v = cover_of(r, p);
  if (!(v.certainty > 0)) {
    for (int n = 0; n < PLANES; n++) r.result[p.in(r, PLANES, n)] = r.surfaces[p.in(r, PLANES, n)];
    return;
  }
  EACH_CHANNEL {
    const float other = covered_light(r, p, v, c);
    r.result[p.in(r, PLANES, c)] = (r.light[p.in(r, CHANNELS, c)] - v.both * other) / (1 - v.both);
    r.result[p.in(r, PLANES, OTHER + c)] = other;
  }
  r.result[p.in(r, PLANES, COC)] = covered_coc(r, p, v);
  r.result[p.in(r, PLANES, WEIGHT)] = v.both;
}

// The gradients by the surfaces of `split` and by those of the matte; that by the light is the first of the gradients by the values.
extern "C" __global__ void cover_back(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const Cover v = cover_of(r, p);
  const bool is_covered = v.certainty > 0, has_other = v.both > 0;
  float of_kept = 0, of_given = 0, of_both = is_covered ? r.of_result[p.in(r, PLANES, WEIGHT)] : 0.0f, of_known = 0, of_certainty = 0;
  EACH_CHANNEL {
    const float of_own = r.of_result[p.in(r, PLANES, c)], of_other = r.of_result[p.in(r, PLANES, OTHER + c)];
    const float light = r.light[p.in(r, CHANNELS, c)], given = r.covered[p.in(r, CHANNELS + 3, c)], split = r.surfaces[p.in(r, PLANES, OTHER + c)];
    const float other = covered_light(r, p, v, c), own = (light - v.both * other) / (1 - v.both), of_left = of_own / (1 - v.both);
    const float of_sum = is_covered && has_other ? (of_other - of_left * v.both) / v.known : 0.0f;  // by the other light times `known`
    of_both += is_covered ? of_left * (own - other) : 0.0f;
    of_kept += of_sum * split;
    of_certainty += of_sum * given * light;
    of_known -= of_sum * other;
    r.of_surfaces[p.in(r, PLANES, c)] = is_covered ? 0.0f : of_own;
    r.of_surfaces[p.in(r, PLANES, OTHER + c)] = is_covered ? of_sum * v.kept : of_other;
    r.of_values[p.in(r, VALUES, c)] = is_covered ? of_left + of_sum * v.certainty * given : 0.0f;
    r.of_covered[p.in(r, CHANNELS + 3, c)] = of_sum * v.certainty * light;
  }
  const float of_coc = r.of_result[p.in(r, PLANES, COC)], of_sum = is_covered && has_other ? of_coc / v.known : 0.0f;
  of_kept += of_sum * r.surfaces[p.in(r, PLANES, COC)];
  of_given += of_sum * r.covered[p.in(r, CHANNELS + 3, CHANNELS)];
  of_known -= of_sum * covered_coc(r, p, v);
  if (v.both >= LEAST) of_both += of_known;
  of_kept += of_both, of_given += of_both;
  r.of_surfaces[p.in(r, PLANES, COC)] = is_covered && has_other ? of_sum * v.kept : of_coc;
  r.of_surfaces[p.in(r, PLANES, WEIGHT)] = is_covered ? of_kept * (1 - v.certainty) : r.of_result[p.in(r, PLANES, WEIGHT)];
  r.of_covered[p.in(r, CHANNELS + 3, CHANNELS)] = of_sum * v.given;
  r.of_covered[p.in(r, CHANNELS + 3, CHANNELS + 1)] = of_given * v.certainty;
  const float weight = r.covered[p.in(r, CHANNELS + 3, CHANNELS + 1)];
  r.of_covered[p.in(r, CHANNELS + 3, CHANNELS + 2)] = of_certainty + of_given * weight - of_kept * r.surfaces[p.in(r, PLANES, WEIGHT)];
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
        const Pixel q = p.around(r, i);
        const bool is_near = counts(r, q) > 0 && coc_of(r, q) == e.near, is_far = counts(r, q) > 0 && coc_of(r, q) == e.far;
        if (pass)
          at(OF_COC, i) += (is_near ? of_near / nearest : 0.0f) + (is_far ? of_far / farthest : 0.0f);
        else
          nearest += is_near, farthest += is_far;
      }
    }
  }
};

// The gradients by what a split is computed from.
struct OfSplit {
  float near, far, coc, gap, weight, edge, covered, variance;
  float near_light[CHANNELS], far_light[CHANNELS], middle[CHANNELS];  // by the mean colours, and by the pixel's own light
};

// Step 5 back; `of` is zero before.
__device__ inline void moved_back(const Run &r, const Pixel &p, const Split &s, const Parts &parts, OfSplit &of) {
  const float own = 1 - s.weight, known = torchdof::max(s.weight, LEAST), squares = s.weight * s.weight + own * own;
  const float of_coc = r.of_surfaces[p.in(r, PLANES, COC)];
  float of_own = 0, of_lent = 0;
  of.near += s.is_near ? 0.0f : of_coc;
  of.far += s.is_near ? of_coc : 0.0f;
  of.weight += r.of_surfaces[p.in(r, PLANES, WEIGHT)];
  EACH_CHANNEL {
    const Moved m = moved_of(r, p, s, c);
    const float moved = torchdof::min(m.steps[3], s.weight * m.most), other_light = moved / known;
    const float of_left = r.of_surfaces[p.in(r, PLANES, c)] * s.scale / own;
    const float of_other = s.weight > 0 ? r.of_surfaces[p.in(r, PLANES, OTHER + c)] * s.scale : 0.0f;
    of.middle[c] += of_left;
    of_own -= of_left * ((m.light - moved) / own);
    if (s.weight >= LEAST) of.weight -= of_other * other_light / known;
    float of_moved = of_other / known - of_left;
    // each limit takes the gradient where it is in force, and half of it where both values are equal
    auto taken = [&](bool limits, bool equals) {
      const float part = limits ? of_moved : equals ? 0.5f * of_moved : 0.0f;
      of_moved -= part;
      return part;
    };
    const float highest = s.weight * m.most, lowest = s.weight * m.least, own_least = m.light - own * m.least, own_most = m.light - own * m.most;
    const float by_highest = taken(highest < m.steps[3], highest == m.steps[3]), by_lowest = taken(lowest > m.steps[2], lowest == m.steps[2]);
    const float by_own_least = taken(own_least < m.steps[1], own_least == m.steps[1]);
    const float by_own_most = taken(own_most > m.steps[0], own_most == m.steps[0]);
    of.weight += by_highest * m.most + by_lowest * m.least;
    of.middle[c] += by_own_least + by_own_most;
    of_own -= by_own_least * m.least + by_own_most * m.most;
    const float dark = r.darkest[p.item * CHANNELS + c] / s.scale, bright = r.brightest[p.item * CHANNELS + c] / s.scale;
    parts.of_end(c) = absolute(dark) <= UNBOUNDED ? (by_lowest * s.weight - by_own_least * own) * s.per_scale : 0.0f;
    parts.of_end(CHANNELS + c) = absolute(bright) <= UNBOUNDED ? (by_highest * s.weight - by_own_most * own) * s.per_scale : 0.0f;
    // moved = weight (other_mean + residual each), each = lent weight / squares
    const float of_each = of_moved * s.weight * m.residual, of_residual = of_moved * s.weight * m.each;
    of.weight += of_moved * (m.other_mean + m.residual * m.each) - of_residual * m.other_mean;
    of.weight += of_each * s.lent * (own - s.weight) * (own + s.weight) / (squares * squares);
    of_own -= of_residual * m.own_mean + of_each * s.lent * 2 * s.weight * own / (squares * squares);
    of_lent += of_each * s.weight / squares;
    of.middle[c] += of_residual;
    const float of_own_mean = -of_residual * own, of_other_mean = of_moved * s.weight - of_residual * s.weight;
    of.near_light[c] += s.by_owner(of_own_mean, of_other_mean);
    of.far_light[c] += s.by_owner(of_other_mean, of_own_mean);
  }
  // lent = 1 - sharper, sharper = |coc| - |coc of the other surface|
  const float of_sharper = within(1 - s.sharper) ? -of_lent : 0.0f;
  of.coc += of_sharper * sign(s.coc);
  of.near -= s.is_near ? 0.0f : of_sharper * sign(s.ends.near);
  of.far -= s.is_near ? of_sharper * sign(s.ends.far) : 0.0f;
  of.weight -= of_own;
}

// Steps 4 and 3 back.
__device__ inline void weight_back(const Run &r, const Pixel &p, const Split &s, OfSplit &of) {
  const float sum = s.noise + s.contradiction, agreeing = s.noise / sum, of_by_place = of.weight * agreeing;
  const float of_agreeing = of.weight * s.by_place / sum, of_contradiction = -of_agreeing * agreeing;
  const float cover = torchdof::min(s.by_cover, 0.5f), fit = torchdof::min(s.by_fit, 0.5f), wide = clamp01(s.wide), doubt = 1 - s.trust;
  const float of_clear = of_by_place * cover * doubt * wide + of.weight * fit * s.trust;
  const float of_trust = (of.weight * fit - of_by_place * cover * wide) * s.clear;
  const float of_cover = s.by_cover <= 0.5f ? of_by_place * s.clear * doubt * wide : 0.0f;
  const float of_fit = s.by_fit <= 0.5f ? of.weight * s.clear * s.trust : 0.0f;
  const float off = s.covered - s.fitted, of_off = of_contradiction * 2 * off * s.strength;
  of.covered += of_off + s.by_owner(-of_cover, of_cover);
  float of_fitted = s.by_owner(-of_fit, of_fit) - of_off;
  of.edge += of_clear * clamp01(torchdof::unlimited_sided(s.sided()));
  const float of_sided = within(torchdof::unlimited_sided(s.sided())) ? PLACE_SLOPE * of_clear * s.edge / s.gap : 0.0f;
  of.coc += 2 * sign(s.side) * of_sided;
  of.near -= sign(s.side) * of_sided;
  of.far -= sign(s.side) * of_sided;
  of.gap += (within(s.wide) ? of_by_place * cover * s.clear * doubt / EDGE_PX : 0.0f) - of_sided * s.sided();
  const float of_total = -of_trust * s.trust / s.total, of_misfit = of_contradiction + of_total * TRUST;
  float of_strength = of_trust / s.total + of_total + of_contradiction * off * off;
  of.variance += of_total * TRUST + of_agreeing * (1 - agreeing);
  EACH_CHANNEL {
    const float left = s.light(r, p, c) - s.seen.far[c] - s.fitted * s.seen.contrast(c);
    of_fitted -= 2 * of_misfit * left * s.seen.contrast(c);
  }
  const float of_along = within(s.along) ? of_fitted / torchdof::max(s.strength, LEAST) : 0.0f;
  if (s.strength >= LEAST) of_strength -= of_along * s.along;
  EACH_CHANNEL {
    const float contrast = s.seen.contrast(c), from_far = s.light(r, p, c) - s.seen.far[c];
    const float of_left = 2 * of_misfit * (from_far - s.fitted * contrast), of_from_far = of_left + of_along * contrast;
    const float of_contrast = of_along * from_far + 2 * of_strength * contrast - of_left * s.fitted;
    of.middle[c] += of_from_far;
    of.near_light[c] += of_contrast;
    of.far_light[c] -= of_from_far + of_contrast;
  }
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
  OfSplit of = {};
  moved_back(r, p, s, parts, of);
  weight_back(r, p, s, of);

  // Step 2 back. seen = light - limited contrast, share = per_strength sum((light - clean) contrast), of the clean colours
  float of_contrast[CHANNELS] = {}, of_strength = 0;
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Neighbour n = s.neighbour(r, p, i);
    const Light l = s.light(r, n);
    float of_nearer = -of.variance * s.seen.near_variance / s.total_nearer, of_share = 0;
    float of_farther = -of.variance * s.seen.far_variance / s.total_farther;
    EACH_CHANNEL {
      const float seen = l.value[c] - l.limited * s.clean.contrast(c);
      const float of_seen = s.colours_back(s.seen, c, n, seen, of.near_light[c], of.far_light[c], of.variance, of_nearer, of_farther);
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
    const float of_nearness = (PLACE_SLOPE * n.unmixed * of_sides + of.covered * falloff(i, SOFTNESS_FALLOFF) * valid * s.per_counted) / s.gap;
    of.far += of_nearness;
    of.gap -= of_nearness * n.nearness;
    parts.at(OF_EDGE, i) = (i == MIDDLE ? of.edge : 0.0f) - falloff(i, FALLOFF) * valid * (of_nearer * clamp01(near) + of_farther * clamp01(far));
    parts.at(OF_COC, i) = (i == MIDDLE ? of.coc : 0.0f) - of_nearness;
  }
  parts.add_ends(r, p, s.ends, of.near - of.gap, of.far + of.gap);
}

// Adds the parts of the gradients by `planes` values of a pixel. A pixel of the border is around others, and itself, several times.
extern "C" __global__ void gather(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const bool is_border = p.y == 0 || p.x == 0 || p.y == r.height - 1 || p.x == r.width - 1;
  float sum[VALUES] = {};
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Pixel q = p.around(r, i);
    if (q.y != p.y + i / 3 - 1 || q.x != p.x + i % 3 - 1 || !(edge_of(r, q) > 0)) continue;
    const Parts parts(r, q);
    const int opposite = TAPS - 1 - i;
    TAP_BY_TAP for (int j = is_border ? 0 : opposite; j <= (is_border ? TAPS - 1 : opposite); j++) {
      const Pixel o = q.around(r, j);
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
    const Pixel q = p.around(r, i);
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
