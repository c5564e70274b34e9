// What the kernels of matting.cu work on: maps, pixels, and the small rules of edges and of clean light.
#pragma once
#include "constants/matting.h"
#include "mixed_pixel.h"

using torchdof::absolute;
using torchdof::clamp01;
using torchdof::LEAST;
using torchdof::sign;
using torchdof::TINY;
using torchdof::within;
using namespace torchdof::constants::matting;

constexpr int TAPS = 9, MIDDLE = TAPS / 2;       // pixels around one, row by row
// Planes of the surfaces: own light, other light, coc and weight of the other surface
constexpr int OTHER = CHANNELS, COC = 2 * CHANNELS, WEIGHT = COC + 1, PLANES = WEIGHT + 1;
// Planes of the gradients by a pixel's values: light, coc, certainty, clean light. Rows of the parts: nine of each, and of the ends
constexpr int OF_COC = CHANNELS, OF_EDGE = OF_COC + 1, OF_CLEAN = OF_EDGE + 1, VALUES = OF_CLEAN + CHANNELS;
constexpr int OF_ENDS = VALUES * TAPS;

// Loops: over channels and over planes, whose values stay in registers; and over pixels around, not unrolled, for a small program.
#define EACH_CHANNEL _Pragma("unroll") for (int c = 0; c < CHANNELS; c++)
#define EACH_VALUE _Pragma("unroll") for (int n = 0; n < VALUES; n++)
#define TAP_BY_TAP _Pragma("unroll 1")

// What a kernel works on, filled in by matting.py: one member a line.
struct Run {
  const float *light;      // [items, CHANNELS, height, width]
  const float *coc;        // [items, height, width]
  const float *valid;      // the same, 0 where a pixel is left out; null: all count
  const float *darkest;    // light of an item, [items, CHANNELS]
  const float *brightest;  // the same
  float *edge;             // certainty that a pixel lies at an edge, 0 to 1, as coc
  float *clean;            // as light
  float *surfaces;         // [items, PLANES, height, width]
  const int *slots;        // place in the parts of a pixel at an edge, counted from 1, as coc
  float *parts;            // [OF_ENDS + 2 CHANNELS, count]
  const float *of_surfaces;  // as surfaces
  float *of_values;        // [items, VALUES, height, width]
  float *of_rows;          // of darkest and brightest, and how many pixels have this light: [items, 4 CHANNELS, height]
  const float *of_ends;    // the same of an item, [items, 4 CHANNELS]
  int height;
  int width;
  int count;   // of pixels at edges
  int planes;  // of the values that are gathered
  int first;   // the first of them
};

#include "pixel.h"

// One of the 3 x 3 pixels around, counted row by row.
__device__ inline Pixel around(const Run &r, const Pixel &p, int i) { return p.at(r, i / 3 - 1, i % 3 - 1); }
__device__ inline float falloff(int i, float beside) { return i == MIDDLE ? 1.0f : i % 2 ? beside : beside * beside; }
__device__ inline float coc_of(const Run &r, const Pixel &p) { return r.coc[p.in(r, 1, 0)]; }
__device__ inline float edge_of(const Run &r, const Pixel &p) { return r.edge[p.in(r, 1, 0)]; }
__device__ inline float light_of(const Run &r, const Pixel &p, int c) { return r.light[p.in(r, CHANNELS, c)]; }
__device__ inline float counts(const Run &r, const Pixel &p) { return r.valid ? r.valid[p.in(r, 1, 0)] : 1.0f; }

// The coc of the nearest and the farthest pixel around.
struct Ends {
  float near, far;
  __device__ float apart() const { return torchdof::apart_px(near, far); }
};
__device__ inline Ends ends_of(const Run &r, const Pixel &p) {
  Ends e = {NEVER_PX, -NEVER_PX};
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Pixel q = around(r, p, i);
    if (!(counts(r, q) > 0)) continue;
    e.near = torchdof::min(e.near, coc_of(r, q));
    e.far = torchdof::max(e.far, coc_of(r, q));
  }
  return e;
}

// Weight of pixel i around in a mean over unmixed pixels.
__device__ inline float unmixed(const Run &r, const Pixel &q, int i) { return (1 - edge_of(r, q) + UNCLEAN) * falloff(i, FALLOFF) * counts(r, q); }

// The light of a pixel's own surface around it: the mean, and how far it takes the place of the pixel's light.
struct Same {
  float coc, edge, total, enough, mean[CHANNELS];
  __device__ float apart(const Run &r, const Pixel &q) const { return (coc_of(r, q) - coc) / EDGE_PX; }
  __device__ float alike(float apart) const { return 2 - 2 * absolute(apart); }
  __device__ float weight(const Run &r, const Pixel &q, int i) const { return unmixed(r, q, i) * clamp01(alike(apart(r, q))); }
  __device__ float taken() const { return edge * clamp01(enough); }
};
__device__ inline Same same_surface(const Run &r, const Pixel &p) {
  Same s = {coc_of(r, p), edge_of(r, p), 0, 0, {}};
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) s.total += s.weight(r, around(r, p, i), i);
  s.enough = s.total - FEW_CLEAN;
  s.total = torchdof::max(s.total, LEAST);
  TAP_BY_TAP for (int i = 0; i < TAPS; i++) {
    const Pixel q = around(r, p, i);
    const float weight = s.weight(r, q, i);
    EACH_CHANNEL s.mean[c] += light_of(r, q, c) * weight;
  }
  EACH_CHANNEL s.mean[c] /= s.total;
  return s;
}
