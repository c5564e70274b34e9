// The weights of a pixel's surfaces in a layer, and the stand-ins for its background; with their gradients.
#pragma once
#include "frame.h"
#include "mixture.h"
#include "rules.h"

using namespace torchdof;

// Weights of a pixel in a layer: of each surface, and behind the layer.
struct Weights {
  float own[SURFACES], beyond;
};

#if STACKED
// Surfaces that cover a pixel independently, near to far; the formula of _stacked in render/surfaces/frame.py. Of surface j: q, how far
// the layer is clear of less blurred ones; h, the part of the light from behind that it hides in this layer and those behind it; passes,
// the part that its part in front of the layer lets pass; s, the part of the arriving light that stops in the layer.
struct Stack {
  float q[SURFACES], h[SURFACES], passes[SURFACES], s[SURFACES];
  // What the surfaces let pass, without one of them.
  __device__ float visible(int without = -1) const {
    float left = 1;
    for (int j = 0; j < SURFACES; j++) left *= j == without ? 1 : passes[j];
    return left;
  }
};
// The share of a surface at or behind a layer nearby, over HIDING_SHARE, without limits.
__device__ inline float nearby(const Ramps &l, float place) { return l.at_or_behind(end_of_surface(place)) / HIDING_SHARE; }
// How far a surface hides the light from behind, by its share at or behind a layer and by that nearby, both over HIDING_SHARE.
__device__ inline float hides(float own, float near, float q) { return ramp(own, true) + q * (ramp(near, true) - ramp(own, true)); }
__device__ inline Stack stack_of(const Ramps &l, const Pixel &p) {
  Stack t;
  for (int j = 0; j < SURFACES; j++) {
    const float at_or_behind = ramp(l.at_or_behind(p.place[j]), true), share = at_or_behind - ramp(l.behind(p.place[j]), true);
    t.q[j] = 1;
    for (int i = j + 1; i < SURFACES; i++) t.q[j] *= is_clear(p.place[j], p.place[i], p.weight[i], ramp(l.behind(p.place[i]), true));
    t.h[j] = p.weight[j] * hides(at_or_behind / HIDING_SHARE, nearby(l, p.place[j]), t.q[j]);
    t.passes[j] = 1 - t.h[j] + t.h[j] * at_or_behind;
    t.s[j] = p.weight[j] * share / torchdof::max(t.passes[j], LEAST_PASSING);
  }
  return t;
}
__device__ inline Weights weigh(const Ramps &l, const Pixel &p) {
  const Stack t = stack_of(l, p);
  const float visible = t.visible();
  Weights w = {{}, visible * (1 - left_by(t.h, SURFACES, -1))};
  float arriving = 1;
  for (int j = 0; j < SURFACES; j++) {
    w.own[j] = visible * arriving * t.s[j];
    arriving *= 1 - t.s[j];
    w.beyond -= w.own[j];
  }
  return w;
}
// Adds the gradients by places and weights.
__device__ inline void weigh_back(const Ramps &l, const Pixel &p, const Weights &of, float *of_place, float *of_weight) {
  const Stack t = stack_of(l, p);
  const float visible = t.visible(), of_known = of.beyond * visible;
  float of_visible = of.beyond * (1 - left_by(t.h, SURFACES, -1)), of_arriving = 0;  // of_arriving: by the light that arrives at the next surface
  for (int j = 0; j < SURFACES; j++) of_visible += (of.own[j] - of.beyond) * left_by(t.s, j, -1) * t.s[j];
  for (int j = SURFACES - 1; j >= 0; j--) {
    const float of_stopped = (of.own[j] - of.beyond) * visible, passing = torchdof::max(t.passes[j], LEAST_PASSING);
    const float of_s = left_by(t.s, j, -1) * (of_stopped - of_arriving), of_difference = of_s * p.weight[j] / passing;
    of_arriving = of_stopped * t.s[j] + (1 - t.s[j]) * of_arriving;
    const float at_or_behind = ramp(l.at_or_behind(p.place[j]), true), share = at_or_behind - ramp(l.behind(p.place[j]), true);
    const float of_passes = of_visible * t.visible(j) - (t.passes[j] >= LEAST_PASSING ? of_s * t.s[j] / passing : 0.0f);
    const float of_h = of_passes * (at_or_behind - 1) + of_known * left_by(t.h, SURFACES, j), near = nearby(l, p.place[j]);
    const float of_own = of_h * p.weight[j] / HIDING_SHARE, own = at_or_behind / HIDING_SHARE;
    const float of_share = of_difference + of_passes * t.h[j] + of_own * (1 - t.q[j]) * slope_of_ramp(own, true);
    of_place[j] += of_share * slope_of_ramp(l.at_or_behind(p.place[j]), true) / l.width;
    of_place[j] += of_own * t.q[j] * slope_of_ramp(near, true) * slope_of_end(p.place[j]) / l.width;
    of_place[j] -= of_difference * slope_of_ramp(l.behind(p.place[j]), true) / l.next_width;
    of_weight[j] += of_s * share / passing + of_h * hides(own, near, t.q[j]);
  }
}
#else
// One surface, or two that share a pixel.
__device__ inline Mixture<float, SURFACES> mixture_of(const Ramps &l, const Pixel &p) {
  Mixture<float, SURFACES> m;
  m.eased = true;
  for (int j = 0; j < SURFACES; j++) m.weight[j] = p.weight[j], m.ahead[j] = l.at_or_behind(p.place[j]), m.here[j] = l.behind(p.place[j]);
  m.weigh();
  return m;
}
__device__ inline Weights weigh(const Ramps &l, const Pixel &p) {
  const Mixture<float, SURFACES> m = mixture_of(l, p);
  Weights w = {{}, m.beyond()};
  for (int j = 0; j < SURFACES; j++) w.own[j] = m.own(j);
  return w;
}
// Adds the gradients by places and weights.
__device__ inline void weigh_back(const Ramps &l, const Pixel &p, const Weights &of, float *of_place, float *of_weight) {
  float of_ahead[SURFACES], of_here[SURFACES], of_share[SURFACES];
  mixture_of(l, p).back(of.own, of.beyond, of_ahead, of_here, of_share);
  for (int j = 0; j < SURFACES; j++) of_place[j] += of_ahead[j] / l.width + of_here[j] / l.next_width, of_weight[j] += of_share[j];
}
#endif

// The surfaces of a pixel as stand-ins for its background.
__device__ inline StandIns<float, SURFACES, STACKED> stand_ins_of(const Pixel &p) {
  StandIns<float, SURFACES, STACKED> t;
  for (int j = 0; j < SURFACES; j++) t.place[j] = p.place[j], t.weight[j] = p.weight[j];
  t.find();
  return t;
}
