// The split of a pixel at an edge: steps 1 and 2 of matte in torchdof/render/surfaces/matting.py; mixed_pixel.h has the others.
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
  float scale, per_scale;
  float total_nearer, total_farther;  // sums of the weights
  Colours clean, seen;                // of the clean light, and of the light without that of the other surface
  float per_strength;                 // of the contrast of the clean colours
  float per_counted;                  // of the small Gaussian under which the near surface covers the pixel
  torchdof::MixedPixel<float, CHANNELS> mixed;
  float own_light[CHANNELS];          // of the pixel

  __device__ float light(const Run &r, const Pixel &q, int c) const { return light_of(r, q, c) * per_scale; }
  __device__ Neighbour neighbour(const Run &r, const Pixel &p, int i) const {
    Neighbour n = {around(r, p, i), 0, 0, 0, 0};
    n.nearness = (ends.far - coc_of(r, n.pixel)) / mixed.gap;  // a division: the limits enlarge rounding
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
  s.mixed.gap = s.ends.far - s.ends.near;

  // Step 2: their colours
  s.scale = TINY;
  s.total_nearer = s.total_farther = s.per_counted = 0;
  float covered = 0;
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Neighbour n = s.neighbour(r, p, i);
    const float small = falloff(i, SOFTNESS_FALLOFF) * counts(r, n.pixel);
    s.total_nearer += n.nearer;
    s.total_farther += n.farther;
    covered += small * n.nearness;
    s.per_counted += small;
    EACH_CHANNEL s.scale = torchdof::max(s.scale, absolute(light_of(r, n.pixel, c)));
  }
  s.per_scale = 1 / s.scale;
  s.total_nearer = torchdof::max(s.total_nearer, LEAST);
  s.total_farther = torchdof::max(s.total_farther, LEAST);
  s.per_counted = 1 / torchdof::max(s.per_counted, LEAST);
  s.clean = s.colours(r, p, [](const Light &l, int c) { return l.clean[c]; });
  float strength = TEXTURE * s.clean.variance() + ALIKE * ALIKE;
  EACH_CHANNEL strength += s.clean.contrast(c) * s.clean.contrast(c);
  s.per_strength = 1 / strength;
  const Colours &clean = s.clean;
  s.seen = s.colours(r, p, [&clean](const Light &l, int c) { return l.value[c] - l.limited * clean.contrast(c); });

  // Steps 3 and 4: the part of the pixel that the other surface covers
  s.mixed.coc = coc_of(r, p), s.mixed.near_px = s.ends.near, s.mixed.far_px = s.ends.far;
  s.mixed.edge = edge_of(r, p), s.mixed.covered = covered * s.per_counted, s.mixed.variance = s.seen.variance();
  EACH_CHANNEL s.own_light[c] = s.light(r, p, c);
  s.mixed.weigh(s.own_light, s.seen.near, s.seen.far);
  return s;
}

// Step 5, of a channel.
using Moved = torchdof::MixedPixel<float, CHANNELS>::Moved;
__device__ inline Moved moved_of(const Run &r, const Pixel &p, const Split &s, int c) {
  const int end = p.item * CHANNELS + c;
  return s.mixed.moved(s.own_light[c], s.seen.near[c], s.seen.far[c], r.darkest[end] / s.scale, r.brightest[end] / s.scale);
}
