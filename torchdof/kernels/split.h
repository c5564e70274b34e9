// The split of a pixel at an edge: steps 1 to 5 of matte in torchdof/render/surfaces/matting.py.
#pragma once
#include "matting.h"

// The mean colours of both surfaces, and their variances, summed over channels.
struct Colours {
  float near[CHANNELS], far[CHANNELS], near_variance, far_variance;
  __device__ float contrast(int c) const { return near[c] - far[c]; }
  __device__ float variance() const { return far_variance + near_variance; }
};

// A pixel around one at an edge: its place between the far surface, 0, and the near one, 1; and its weights in the means of both.
struct Neighbour {
  Pixel pixel;
  float nearness, unmixed, nearer, farther;
};
// Its light, and the part of the other surface in it as a multiple of the contrast of the clean colours.
struct Light {
  float value[CHANNELS], clean[CHANNELS], share, limited;
};

// The split of a pixel at an edge. Light is relative to the brightest light around, `scale`.
struct Split {
  Ends ends;
  float coc, gap, scale, per_scale;
  bool is_near;                       // whether the pixel's own surface is the near one
  float total_nearer, total_farther;  // sums of the weights
  Colours clean, seen;                // of the clean light, and of the light without that of the other surface
  float per_strength;                 // of the contrast of the clean colours
  float covered, per_counted;         // by the near surface, under the small Gaussian; and its norm
  float strength, along, fitted, misfit, noise, total, trust, edge, side, clear, contradiction, by_fit, by_cover, wide, by_place, weight;
  float sharper, lent;

  __device__ float by_owner(float if_near, float if_far) const { return is_near ? if_near : if_far; }
  __device__ float sided() const { return absolute(side) / gap; }
  __device__ float light(const Run &r, const Pixel &q, int c) const { return light_of(r, q, c) * per_scale; }
  __device__ Neighbour neighbour(const Run &r, const Pixel &p, int i) const {
    Neighbour n = {p.around(r, i), 0, 0, 0, 0};
    n.nearness = (ends.far - coc_of(r, n.pixel)) / gap;  // a division: the limits enlarge rounding
    n.unmixed = unmixed(r, n.pixel, i);
    n.nearer = n.unmixed * torchdof::on_near(n.nearness);
    n.farther = n.unmixed * torchdof::on_far(n.nearness);
    return n;
  }
  __device__ Light light(const Run &r, const Neighbour &n) const {
    Light l;
    l.share = 0;
    EACH_CHANNEL {
      l.value[c] = light(r, n.pixel, c);
      l.clean[c] = torchdof::max(torchdof::min(r.clean[n.pixel.in(r, CHANNELS, c)] * per_scale, MOST_CLEAN), -MOST_CLEAN);
      l.share += (l.value[c] - l.clean[c]) * clean.contrast(c);
    }
    l.share *= per_strength;
    l.limited = n.nearer > n.farther ? -clamp01(-l.share) : clamp01(l.share);
    return l;
  }
  // The colours of the light `value(light, channel)` around.
  template <typename Value>
  __device__ Colours colours(const Run &r, const Pixel &p, Value value) const {
    Colours m = {};
    TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
      const Neighbour n = neighbour(r, p, i);
      const Light l = light(r, n);
      EACH_CHANNEL {
        m.near[c] += value(l, c) * n.nearer;
        m.far[c] += value(l, c) * n.farther;
      }
    }
    EACH_CHANNEL {
      m.near[c] /= total_nearer;
      m.far[c] /= total_farther;
    }
    TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
      const Neighbour n = neighbour(r, p, i);
      const Light l = light(r, n);
      EACH_CHANNEL {
        m.near_variance += (value(l, c) - m.near[c]) * (value(l, c) - m.near[c]) * n.nearer;
        m.far_variance += (value(l, c) - m.far[c]) * (value(l, c) - m.far[c]) * n.farther;
      }
    }
    m.near_variance /= total_nearer;
    m.far_variance /= total_farther;
    return m;
  }
  // The gradient by a value, from those by the means and by the sum of the variances; adds those by the weights.
  __device__ float colours_back(const Colours &m, int c, const Neighbour &n, float value, float of_near, float of_far, float of_variance,
                                float &of_nearer, float &of_farther) const {
    const float near = value - m.near[c], far = value - m.far[c], per_nearer = 1 / total_nearer, per_farther = 1 / total_farther;
    of_nearer += near * (of_near + of_variance * near) * per_nearer;
    of_farther += far * (of_far + of_variance * far) * per_farther;
    return n.nearer * per_nearer * (of_near + 2 * of_variance * near) + n.farther * per_farther * (of_far + 2 * of_variance * far);
  }
};

__device__ inline Split split_of(const Run &r, const Pixel &p) {
  Split s = {};
  // Step 1: the two surfaces
  s.ends = ends_of(r, p);
  s.coc = coc_of(r, p);
  s.gap = s.ends.far - s.ends.near;
  s.is_near = s.coc - s.ends.near < s.ends.far - s.coc;
  s.edge = edge_of(r, p);

  // Step 2: their colours
  s.scale = TINY;
  s.total_nearer = s.total_farther = s.covered = s.per_counted = 0;
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Neighbour n = s.neighbour(r, p, i);
    const float small = falloff(i, SOFTNESS_FALLOFF) * counts(r, n.pixel);
    s.total_nearer += n.nearer;
    s.total_farther += n.farther;
    s.covered += small * n.nearness;
    s.per_counted += small;
    EACH_CHANNEL s.scale = torchdof::max(s.scale, absolute(light_of(r, n.pixel, c)));
  }
  s.per_scale = 1 / s.scale;
  s.total_nearer = torchdof::max(s.total_nearer, LEAST);
  s.total_farther = torchdof::max(s.total_farther, LEAST);
  s.per_counted = 1 / torchdof::max(s.per_counted, LEAST);
  s.covered *= s.per_counted;
  s.clean = s.colours(r, p, [](const Light &l, int c) { return l.clean[c]; });
  s.strength = TEXTURE * s.clean.variance() + ALIKE * ALIKE;
  EACH_CHANNEL s.strength += s.clean.contrast(c) * s.clean.contrast(c);
  s.per_strength = 1 / s.strength;
  const Colours &clean = s.clean;
  s.seen = s.colours(r, p, [&clean](const Light &l, int c) { return l.value[c] - l.limited * clean.contrast(c); });

  // Steps 3 and 4: the part of the pixel that the other surface covers
  s.along = s.strength = s.misfit = 0;
  EACH_CHANNEL {
    s.strength += s.seen.contrast(c) * s.seen.contrast(c);
    s.along += (s.light(r, p, c) - s.seen.far[c]) * s.seen.contrast(c);
  }
  s.along /= torchdof::max(s.strength, LEAST);
  s.fitted = clamp01(s.along);
  EACH_CHANNEL {
    const float left = s.light(r, p, c) - s.seen.far[c] - s.fitted * s.seen.contrast(c);
    s.misfit += left * left;
  }
  s.noise = s.seen.variance() + ALIKE * ALIKE;
  s.total = s.strength + TRUST * (s.seen.variance() + s.misfit) + ALIKE * ALIKE;
  s.trust = s.strength / s.total;
  s.side = (s.coc - s.ends.near) - (s.ends.far - s.coc);
  s.clear = s.edge * clamp01(torchdof::unlimited_sided(s.sided()));
  s.by_fit = s.by_owner(1 - s.fitted, s.fitted);
  s.by_cover = s.by_owner(1 - s.covered, s.covered);
  s.wide = s.gap / EDGE_PX - 2;
  s.by_place = torchdof::min(s.by_cover, 0.5f) * s.clear * (1 - s.trust) * clamp01(s.wide);
  s.contradiction = s.misfit + (s.covered - s.fitted) * (s.covered - s.fitted) * s.strength;
  s.weight = torchdof::min(s.by_fit, 0.5f) * s.clear * s.trust + s.by_place * s.noise / (s.noise + s.contradiction);
  s.sharper = absolute(s.coc) - absolute(s.by_owner(s.ends.far, s.ends.near));
  s.lent = clamp01(1 - s.sharper);
  return s;
}

// Step 5: light of the other surface times its weight, and the steps to it: without limits, then with one after the other.
struct Moved {
  float light, own_mean, other_mean, residual, each, least, most, steps[4];
};
__device__ inline Moved moved_of(const Run &r, const Pixel &p, const Split &s, int c) {
  Moved m;
  const float own = 1 - s.weight;
  m.light = s.light(r, p, c);
  m.own_mean = s.by_owner(s.seen.near[c], s.seen.far[c]), m.other_mean = s.by_owner(s.seen.far[c], s.seen.near[c]);
  m.residual = m.light - own * m.own_mean - s.weight * m.other_mean;
  m.each = s.lent * s.weight / (s.weight * s.weight + own * own);
  m.least = torchdof::max(r.darkest[p.item * CHANNELS + c] / s.scale, -UNBOUNDED);
  m.most = torchdof::min(r.brightest[p.item * CHANNELS + c] / s.scale, UNBOUNDED);
  m.least = torchdof::min(m.least, UNBOUNDED), m.most = torchdof::max(m.most, -UNBOUNDED);
  m.steps[0] = s.weight * (m.other_mean + m.residual * m.each);
  m.steps[1] = torchdof::max(m.steps[0], m.light - own * m.most);
  m.steps[2] = torchdof::min(m.steps[1], m.light - own * m.least);
  m.steps[3] = torchdof::max(m.steps[2], s.weight * m.least);
  return m;
}
