// Finds the edges of maps of depth, and judges their pixels by colour, on a GPU: edge_search.py, edge_colours.py and
// edge_prior.py in torchdof/render/surfaces, whose docstrings have the steps. NVRTC compiles this file at first use, with the
// number CHANNELS defined. Forward only; without shared memory, barriers and atomic operations, as layers.cu.
//
//   find_slopes    slope, jump and steepness of each pixel
//   smooth_slopes  the mean slope around it
//   find_ramps     whether it lies on a ramp, and its nearness as both surfaces
//   climb_ramps    both surfaces around pixels on ramps, a pixel farther with each launch
//   find_surfaces  ramps and steps, and their two surfaces
//   judge          the score of pixels of a list, from samples around them
//   decide         the mean of scores of like neighbours
//   fit            the prior of each kind of pixel, from the scores of samples
#include "constants/windows.h"
#include "edge_rules.h"

using torchdof::absolute;
using torchdof::max;
using torchdof::min;
using torchdof::Extremes;
using namespace torchdof::constants::edge_colours;
using namespace torchdof::constants::edge_search;
using torchdof::constants::windows::NEVER;

#define EACH_CHANNEL _Pragma("unroll") for (int c = 0; c < CHANNELS; c++)

// Planes: of the work; two of surfaces, so that a launch reads the one and writes the other
enum { SLOPE, JUMP, STEEPNESS, SMOOTH, RAMP, SURFACES, WORK = SURFACES + 4 };
// of the edges; of what pixels look like; and of what they show
enum { NEAR, FAR, LEVEL, CLIMB, EDGES };
enum { NEARNESS = CHANNELS, WEIGHT, OF_NEAR, OF_FAR, ON_RAMP };
enum { SCORE, EVIDENCE, SHOWN_NEAR, SHOWN_FAR, RELIABILITY };
constexpr int SIDE = 2 * REACH + 1, BLOCK = 128;  // of the window of samples; threads for a list, as in edges.py

// What a kernel works on, filled in by edges.py: one member a line.
struct Run {
  const float *nearness;    // [items, height, width]
  const bool *valid;        // the same
  const float *step;        // the same: smallest difference in nearness of two surfaces
  float *work;              // [items, WORK, height, width]
  float *edges;             // [items, EDGES, height, width]
  bool *is_ramp;            // as nearness
  bool *is_edge;            // the same
  long long *ring;          // the same: distance to a step
  long long *direction;     // the same
  const float *looks;       // [CHANNELS + 5, items, height, width]
  const long long *chosen;  // indices of pixels, [count]
  const float *falloff;     // weights of a window of samples, [SIDE, SIDE]
  const float *sharpness;   // of an item, [items]
  float *scores;            // of pixels of the list, as nearness, NaN elsewhere
  float *shown;             // [5, count]
  const float *sampled;     // scores of samples, in the order of their kinds
  const long long *starts;  // of each kind among them, [items, PLACES, DIRECTIONS], and their number
  float *shares;            // by place, [items, PLACES]
  float *prior;             // by kind, [items, PLACES, DIRECTIONS]
  int height;
  int width;
  int items;
  int count;     // of pixels; of shares that are fitted
  int turn;      // of the two surfaces that a launch reads
  int is_prior;  // whether the shares of wrong pixels are estimated
  int mixtures;  // whether mixed colours count as a more blurred near surface
};

#include "pixel.h"

__device__ inline float nearness(const Run &r, const Pixel &p) { return r.nearness[p.in(r, 1, 0)]; }
__device__ inline bool is_valid(const Run &r, const Pixel &p) { return r.valid[p.in(r, 1, 0)]; }
__device__ inline float &work(const Run &r, const Pixel &p, int plane) { return r.work[p.in(r, WORK, plane)]; }
// The nearness of a surface at a pixel: that of the near one, or that of the far one, negated.
__device__ inline float &surface(const Run &r, const Pixel &p, int far) { return work(r, p, SURFACES + 2 * r.turn + far); }
__device__ inline float own_surface(const Run &r, const Pixel &p, int far) {
  return is_valid(r, p) ? (far ? -nearness(r, p) : nearness(r, p)) : -NEVER;
}
// The change from a pixel to the one at an offset; 0 where one is not valid.
__device__ inline float change(const Run &r, const Pixel &p, int dy, int dx) {
  const Pixel q = p.at(r, dy, dx);
  return is_valid(r, p) && is_valid(r, q) ? nearness(r, q) - nearness(r, p) : 0.0f;
}
// Calls visit(pixel, dy, dx) for those up to `reach` around one.
template <typename Visit>
__device__ inline void each_around(const Run &r, const Pixel &p, int reach, const Visit &visit) {
  for (int dy = -reach; dy <= reach; dy++)
    for (int dx = -reach; dx <= reach; dx++) visit(p.at(r, dy, dx), dy, dx);
}

extern "C" __global__ void find_slopes(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const float right = change(r, p, 0, 1), below = change(r, p, 1, 0), left = change(r, p, 0, -1), above = change(r, p, -1, 0);
  const torchdof::Slope<float> found(-left, right, -above, below);
  work(r, p, SLOPE) = found.slope;
  work(r, p, JUMP) = found.jump;
  work(r, p, STEEPNESS) = 0.25f * (hypotf(left, above) + hypotf(left, below) + hypotf(right, above) + hypotf(right, below));
}

extern "C" __global__ void smooth_slopes(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  float sum = 0;
  each_around(r, p, 2, [&](const Pixel &q, int, int) { sum += work(r, q, SLOPE); });
  work(r, p, SMOOTH) = sum / 25;
}

extern "C" __global__ void find_ramps(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const float slope = work(r, p, SLOPE), step = r.step[p.in(r, 1, 0)];
  bool is_ramp = is_valid(r, p) && slope > LEAST_SLOPE * step;
  if (is_ramp) {
    float near = -NEVER, far = -NEVER, flattest = NEVER;
    each_around(r, p, REACH, [&](const Pixel &q, int, int) {
      near = max(near, own_surface(r, q, 0));
      far = max(far, own_surface(r, q, 1));
    });
    each_around(r, p, FLAT_REACH, [&](const Pixel &q, int, int) { flattest = min(flattest, work(r, q, SMOOTH)); });
    is_ramp = slope > SHALLOW * (near + far) && near + far > step && flattest < FLAT * slope;
  }
  work(r, p, RAMP) = is_ramp;
  for (int far = 0; far < 2; far++) surface(r, p, far) = own_surface(r, p, far);
}

extern "C" __global__ void climb_ramps(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const int reach = work(r, p, RAMP) > 0 ? 1 : 0;
  for (int far = 0; far < 2; far++) {
    float most = -NEVER;
    each_around(r, p, reach, [&](const Pixel &q, int, int) { most = max(most, surface(r, q, far)); });
    work(r, p, SURFACES + 2 * (1 - r.turn) + far) = most;
  }
}

extern "C" __global__ void find_surfaces(const __grid_constant__ Run r) {
  const Pixel p;
  if (!p.is_in(r)) return;
  const long long at = p.in(r, 1, 0);
  const auto is_ramp = [&r](const Pixel &q) { return work(r, q, RAMP) > 0 && surface(r, q, 0) + surface(r, q, 1) > r.step[q.in(r, 1, 0)]; };
  Extremes<float> within[RINGS + 1];
  for (int k = 0; k <= RINGS; k++) within[k] = {-NEVER, -NEVER, 0.0f};
  each_around(r, p, RINGS, [&](const Pixel &q, int dy, int dx) {
    const bool climbs = is_ramp(q);
    const float near = climbs ? surface(r, q, 0) : own_surface(r, q, 0), far = climbs ? surface(r, q, 1) : own_surface(r, q, 1);
    _Pragma("unroll") for (int k = 0; k <= RINGS; k++) {  // not by an index, so that the extremes stay in registers
      if (max(dy < 0 ? -dy : dy, dx < 0 ? -dx : dx) > k) continue;
      within[k].near = max(within[k].near, near);
      within[k].far = max(within[k].far, far);
      within[k].jump = max(within[k].jump, work(r, q, JUMP));
    }
  });
  const float step = r.step[at];
  const torchdof::Step<float> found(step, [&within](int k) { return within[k + 1]; });
  const bool climbs = is_ramp(p);
  const float near = climbs ? within[0].near : found.near, far = climbs ? -within[0].far : -found.far, gap = near - far;
  const bool is_edge = (climbs || found.unsure > 0) && gap > step && is_valid(r, p);
  float right = 0, below = 0;
  if (is_edge)
    each_around(r, p, 4, [&](const Pixel &q, int dy, int dx) {
      right += dx == 0 || dy < -2 || dy > 2 ? 0.0f : dx > 0 ? nearness(r, q) : -nearness(r, q);
      below += dy == 0 || dx < -2 || dx > 2 ? 0.0f : dy > 0 ? nearness(r, q) : -nearness(r, q);
    });
  r.is_ramp[at] = climbs;
  r.is_edge[at] = is_edge;
  r.ring[at] = RINGS + 1 - (int)found.unsure;
  r.direction[at] = (int)torchdof::direction(right / 25, below / 25, gap) + DIRECTIONS / 2;
  const float least = max(gap, 1e-12f);
  r.edges[p.in(r, EDGES, NEAR)] = near;
  r.edges[p.in(r, EDGES, FAR)] = far;
  r.edges[p.in(r, EDGES, LEVEL)] = torchdof::clamp01((nearness(r, p) - far) / least);
  r.edges[p.in(r, EDGES, CLIMB)] = is_edge ? work(r, p, STEEPNESS) / least : 0.0f;
}

__device__ inline float look(const Run &r, const Pixel &p, int plane) {
  return r.looks[((long long)(plane * r.items + p.item) * r.height + p.y) * r.width + p.x];
}

// A pixel of the list, with its colour, and the samples of both surfaces around it.
struct Judged {
  Pixel pixel;
  float near, far, own[CHANNELS];
  __device__ Judged(const Run &r, int k) : pixel(r, r.chosen[k]), near(look(r, pixel, OF_NEAR)), far(look(r, pixel, OF_FAR)) {
    EACH_CHANNEL own[c] = look(r, pixel, c);
  }
  // Calls visit(nearness less that of the near surface, weight as a sample of the near and of the far surface, differences of colour).
  template <typename Visit>
  __device__ void each_sample(const Run &r, const Visit &visit) const {
    const float most_off = SAMPLED_GAP * max(near - far, 1e-12f);
    each_around(r, pixel, REACH, [&](const Pixel &q, int dy, int dx) {
      const float weight = r.falloff[(dy + REACH) * SIDE + dx + REACH] * look(r, q, WEIGHT), value = look(r, q, NEARNESS);
      if (!(weight > 0)) return;
      float apart[CHANNELS];
      EACH_CHANNEL apart[c] = look(r, q, c) - own[c];
      visit(value - near, absolute(value - near) < most_off ? weight : 0.0f, absolute(value - far) < most_off ? weight : 0.0f, apart);
    });
  }
};
__device__ inline float square(const float *apart) {
  float sum = 0;
  EACH_CHANNEL sum += apart[c] * apart[c];
  return sum;
}

extern "C" __global__ void judge(const __grid_constant__ Run r) {
  const int k = blockIdx.x * BLOCK + threadIdx.x;
  if (k >= r.count) return;
  const Judged p(r, k);
  float sums[4 + 2 * CHANNELS] = {};
  p.each_sample(r, [&sums](float, float of_near, float of_far, const float *apart) {
    const float of_all = square(apart);
    sums[0] += of_near;
    sums[1] += of_far;
    sums[2] += of_near * of_all;
    sums[3] += of_far * of_all;
    EACH_CHANNEL {
      sums[4 + 2 * c] += of_near * apart[c];
      sums[5 + 2 * c] += of_far * apart[c];
    }
  });
  const torchdof::Separation<float> s(CHANNELS, [&sums](int n) { return sums[n]; }, [&p](int c) { return p.own[c]; });
  float likely_near = 0, likely_far = 0, near = 0, far = 0, total_near = 1e-12f, total_far = 1e-12f;
  p.each_sample(r, [&](float off, float of_near, float of_far, const float *apart) {
    const float t = 1 + square(apart) * s.per_spread, alike = 1 / (t * t);
    likely_near += of_near * alike;
    likely_far += of_far * alike;
    total_near += of_near * (alike + UNLIKE);
    total_far += of_far * (alike + UNLIKE);
    near += of_near * (alike + UNLIKE) * off;
    far += of_far * (alike + UNLIKE) * off;
  });
  const float mixed = r.mixtures ? s.mixed * torchdof::more_blurred(p.near, p.far) : 0.0f;
  const torchdof::Likelihoods<float> found(s, likely_near, likely_far, mixed, r.is_prior ? CLEAR_IN_PRIOR : CLEAR);
  const float odds = max(min(logf(found.odds), MOST_ODDS), -MOST_ODDS);
  const float trust = look(r, p.pixel, ON_RAMP) > 0 ? 1.0f : found.trust;
  r.scores[p.pixel.in(r, 1, 0)] = s.is_known ? odds * trust : 0.0f;
  r.shown[EVIDENCE * r.count + k] = found.evidence;
  r.shown[SHOWN_NEAR * r.count + k] = s.is_known ? p.near + near / total_near : p.near;
  r.shown[SHOWN_FAR * r.count + k] = s.is_known ? p.near + far / total_far : p.far;
  r.shown[RELIABILITY * r.count + k] = s.reliability;
}

extern "C" __global__ void decide(const __grid_constant__ Run r) {
  const int k = blockIdx.x * BLOCK + threadIdx.x;
  if (k >= r.count) return;
  const Judged p(r, k);
  const float per_light = torchdof::per_light(square(p.own));
  float total = 0, sum = 0, strongest = 0;
  each_around(r, p.pixel, 1, [&](const Pixel &q, int, int) {
    const float score = r.scores[q.in(r, 1, 0)];
    if (!(absolute(score) <= MOST_ODDS)) return;  // no pixel of the list
    float apart[CHANNELS];
    EACH_CHANNEL apart[c] = look(r, q, c) - p.own[c];
    const float alike = 1 / (1 + square(apart) * per_light);
    total += alike;
    sum += alike * score;
    strongest = max(strongest, absolute(score));
  });
  const float reliability = r.shown[RELIABILITY * r.count + k], score = r.sharpness[p.pixel.item] * reliability * sum / total;
  float &evidence = r.shown[EVIDENCE * r.count + k];
  evidence = max(torchdof::clamp01(2 * reliability * strongest - 1), evidence);
  r.shown[SCORE * r.count + k] = max(min(score, MOST_SCORE), -MOST_SCORE);
}

// The prior of a place, from all its kinds; then that of a kind, for which it is assumed.
extern "C" __global__ void fit(const __grid_constant__ Run r) {
  const int g = blockIdx.x * BLOCK + threadIdx.x;
  if (g >= r.count) return;
  const bool together = r.turn == 0;
  const int kinds = together ? DIRECTIONS : 1, place = (together ? g : g / DIRECTIONS) % PLACES;
  const long long first = r.starts[g * kinds], last = r.starts[(g + 1) * kinds];
  double total = 0;
  for (long long n = first; n < last; n++) total += torchdof::weight_of(r.sampled[n]);
  const float assumed = together ? torchdof::assumed_share(place) : r.shares[g / DIRECTIONS];
  float share = together ? torchdof::first_share(place) : 0.5f;
  for (int round = 0; round < torchdof::constants::edge_prior::ROUNDS; round++)
    share = torchdof::next_share(share, total, assumed, [&](float odds) {
      double near = 0;
      for (long long n = first; n < last; n++) near += torchdof::weight_of(r.sampled[n]) / (1 + odds * expf(-r.sampled[n]));
      return near;
    });
  (together ? r.shares : r.prior)[g] = share;
}
