// The rules by which edges of depth are found and their pixels judged, steps of
// torchdof/render/surfaces/edge_search.py, edge_colours.py and edge_prior.py. The compiled engine computes vectors V of
// pixels, the kernels of GPUs (torchdof/kernels) single ones.
#pragma once
#include "constants/edge_colours.h"
#include "constants/edge_prior.h"
#include "constants/edge_search.h"
#include "numbers.h"

namespace torchdof {

// The slope at a pixel: the smaller change on both sides if they have one sign, else 0. And its jump: the larger change
// less that. Both are the largest of the two axes. x0, x1, y0, y1: changes before and after the pixel.
template <typename V>
struct Slope {
  V slope, jump;
  Slope(V x0, V x1, V y0, V y1) {
    const V ax0 = absolute(x0), ax1 = absolute(x1), ay0 = absolute(y0), ay1 = absolute(y1);
    const V sx = x0 * x1 > V{} ? min(ax0, ax1) : V{}, sy = y0 * y1 > V{} ? min(ay0, ay1) : V{};
    slope = max(sx, sy);
    jump = max(max(ax0, ax1) - sx, max(ay0, ay1) - sy);
  }
};

// Extremes within some pixels of one: nearness, nearness negated, and jump.
template <typename V>
struct Extremes {
  V near, far, jump;
};

// The step beside a pixel: the nearness of both sides, that of the far one negated; and RINGS + 1 less its ring, 0
// without a step.
template <typename V>
struct Step {
  V near, far, unsure;
  // within(r): extremes within r + 1 pixels. least: smallest difference in nearness of two surfaces.
  template <typename Within>
  Step(V least, const Within &within) : unsure(V{}) {
    using namespace constants::edge_search;
    const Extremes<V> widest = within(RINGS - 1);
    near = widest.near;
    far = widest.far;
    const V least_gap = max(NEAREST * (near + far), least);
    for (int r = RINGS - 1; r >= 0; r--) {
      const Extremes<V> e = within(r);
      const V gap = e.near + e.far;
      const auto is_step = (gap > least_gap) & (e.jump > ABRUPT * gap);
      near = is_step ? e.near : near;
      far = is_step ? e.far : far;
      unsure = is_step ? V{} + (float)(RINGS - r) : unsure;
    }
  }
};

// Direction of the near surface of an edge, -2 (up) to 2 (down), from the rise of nearness to the right and below.
template <typename V>
inline V direction(V right, V below, V gap) {
  const V tie = constants::edge_search::TIE * gap;
  return 2.0f * (absolute(below) > absolute(right) + tie ? sign(below) : V{}) +
         (absolute(right) > absolute(below) + tie ? sign(right) : V{});
}

// What a sample with a score counts, 0 to 1.
inline float weight_of(float score) { return min(0.5f * absolute(score), 1.0f); }

// The share of the pixels of a place that is assumed to show the near surface, and where its first fit starts.
inline float assumed_share(int place) {
  using namespace constants::edge_search;
  const float trusted = constants::edge_prior::TRUSTED;
  return place < RINGS ? trusted : place < 2 * RINGS ? 1.0f - trusted : (place - 2 * RINGS + 0.5f) / LEVELS;
}
inline float first_share(int place) { return place < 2 * constants::edge_search::RINGS ? 0.5f : assumed_share(place); }

// A round of the fit of a share. near_of(odds): the pixels that show the near surface, by these odds of the far one.
// total: of the pixels.
template <typename NearOf>
inline float next_share(float share, double total, float assumed, const NearOf &near_of) {
  using namespace constants::edge_prior;
  const double near = near_of((1.0f - share) / share);
  const float next = (float)((near + PRIOR_COUNT * assumed) / (total + PRIOR_COUNT));
  return min(max(next, 1.0f - MOST_SHARE), MOST_SHARE);
}

// How clearly the near one of two surfaces is the more blurred one, 0 to 1.
template <typename V>
inline V more_blurred(V near, V far) {
  return clamp01((absolute(near) - absolute(far)) / constants::edge_colours::MORE_BLURRED_PX);
}

// The factor on the squared difference between the colours of a pixel and a neighbour. square: of the pixel's colour.
template <typename V>
inline V per_light(V square) {
  return 1.0f / (constants::edge_colours::SIMILAR * square + 1e-12f);
}

// How well colours separate the two surfaces of an edge, from sums over samples of both.
template <typename V>
struct Separation {
  V seen[2];                     // weights of the samples
  decltype(V{} < V{}) is_known;  // whether both surfaces have some, else the neighbours decide
  V per_seen[2];
  V reliability;            // of the score, 0 to 1; grows with the contrast of both surfaces
  V mixed;                  // likelihood that the pixel has a mixture of their colours
  V per_light, per_spread;  // factors on squared differences of colours: of neighbours, and of samples

  // sum(n): of the near and the far surface, 0 and 1: weights; 2 and 3: squared differences of the colours of samples
  // and pixel; 4 + 2 c and 5 + 2 c: differences in channel c. own(c): the colour of the pixel.
  template <typename Sum, typename Own>
  Separation(int channels, const Sum &sum, const Own &own) {
    using namespace constants::edge_colours;
    seen[0] = sum(0), seen[1] = sum(1);
    per_seen[0] = 1.0f / seen[0], per_seen[1] = 1.0f / seen[1];
    V square = {}, contrast = {}, noise = {}, near_mean = {}, far_mean = {}, along = {};
    for (int c = 0; c < channels; c++) {
      const V near = sum(4 + 2 * c) * per_seen[0], far = sum(5 + 2 * c) * per_seen[1],
              both = 2.0f * own(c) + near + far;
      square += own(c) * own(c);
      near_mean += near * near;
      far_mean += far * far;
      contrast += (near - far) * (near - far);
      along += far * (far - near);  // from the far surface's colour towards the near one's
      noise += both * both;
    }
    const V one = V{} + 1.0f;
    V spread = COLOUR_NOISE * noise + 1e-12f;
    spread += 0.5f * max(sum(2) * per_seen[0] - near_mean, V{});
    spread += 0.5f * max(sum(3) * per_seen[1] - far_mean, V{});
    per_light = torchdof::per_light(square);
    per_spread = 1.0f / (SPREAD * spread);
    is_known = (seen[0] > LEAST_SEEN) & (seen[1] > LEAST_SEEN);
    reliability = is_known ? max(contrast / (contrast + 0.5f * spread) - INSEPARABLE, V{}) / (1.0f - INSEPARABLE) : one;
    const V share = max(min(along / max(contrast, V{} + 1e-12f), one), V{});
    const V unmixed = 1.0f + max(far_mean - share * (2.0f * along - share * contrast), V{}) / spread;
    mixed = MIXTURE / (unmixed * unmixed);
  }
};

// Which of both surfaces a pixel resembles: the ratio of their likelihoods, the evidence that it shows one of them, and
// the trust in that ratio beside a step, which few samples reduce; 0 to 1.
template <typename V>
struct Likelihoods {
  V odds, evidence, trust;
  // likely: of both surfaces, sums over the samples that resemble the pixel. mixed: likelihood to add to the near one.
  // clear: weight of samples that suffice.
  Likelihoods(const Separation<V> &s, V likely_near, V likely_far, V mixed, float clear) {
    const V one = V{} + 1.0f, near = likely_near * s.per_seen[0] + 1e-9f + mixed,
            far = likely_far * s.per_seen[1] + 1e-9f;
    evidence = s.is_known ? min(max(near, far) / constants::edge_colours::LIKELY, one) : one;
    odds = near / far;
    trust = min(min(s.seen[0], s.seen[1]) / clear, one);
  }
};

}  // namespace torchdof
