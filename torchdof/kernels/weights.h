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
// Surfaces that cover a pixel independently, near to far; the formula of _stacked in render/surfaces/frame.py. Of surface j: its
// share a at or behind the layer, and b behind it; h, the part of the light from behind that the surface hides in this layer and
// those behind it; hidden, the part that its part in front of the layer hides; s, the part of the arriving light that stops in the layer.
struct Stack {
  float a[SURFACES], b[SURFACES], h[SURFACES], hidden[SURFACES], s[SURFACES];
};
__device__ inline Stack stack_of(const Ramps &l, const Pixel &p) {
  Stack t;
  for (int j = 0; j < SURFACES; j++) {
    t.a[j] = ramp(l.at_or_behind(p.place[j]), true);
    t.b[j] = ramp(l.behind(p.place[j]), true);
    t.h[j] = p.weight[j] * ramp(t.a[j] / HIDING_SHARE, true);
    t.hidden[j] = t.h[j] * (1 - t.a[j]);
    t.s[j] = p.weight[j] * (t.a[j] - t.b[j]) / torchdof::max(1 - t.hidden[j], LEAST_PASSING);
  }
  return t;
}
__device__ inline Weights weigh(const Ramps &l, const Pixel &p) {
  const Stack t = stack_of(l, p);
  const float visible = left_by(t.hidden, SURFACES, -1);
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
  const float visible = left_by(t.hidden, SURFACES, -1), known = 1 - left_by(t.h, SURFACES, -1);
  float of_visible = of.beyond * known, of_arriving = 0;  // of_arriving: by the light that arrives at the next surface
  for (int j = 0; j < SURFACES; j++) of_visible += (of.own[j] - of.beyond) * left_by(t.s, j, -1) * t.s[j];
  for (int j = SURFACES - 1; j >= 0; j--) {
    const float of_stopped = (of.own[j] - of.beyond) * visible, passing = torchdof::max(1 - t.hidden[j], LEAST_PASSING);
    const float of_s = left_by(t.s, j, -1) * (of_stopped - of_arriving), of_difference = of_s * p.weight[j] / passing;
    of_arriving = of_stopped * t.s[j] + (1 - t.s[j]) * of_arriving;
    const float of_hidden = (1 - t.hidden[j] >= LEAST_PASSING ? of_s * t.s[j] / passing : 0.0f) - of_visible * left_by(t.hidden, SURFACES, j);
    const float of_h = of_hidden * (1 - t.a[j]) + of.beyond * visible * left_by(t.h, SURFACES, j), nearer = t.a[j] / HIDING_SHARE;
    const float of_a = of_difference - of_hidden * t.h[j] + of_h * p.weight[j] * slope_of_ramp(nearer, true) / HIDING_SHARE;
    of_place[j] += of_a * slope_of_ramp(l.at_or_behind(p.place[j]), true) / l.width;
    of_place[j] -= of_difference * slope_of_ramp(l.behind(p.place[j]), true) / l.next_width;
    of_weight[j] += of_s * (t.a[j] - t.b[j]) / passing + of_h * ramp(nearer, true);
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
