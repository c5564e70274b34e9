#include "edge_colours.h"

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "edge_rules.h"
#include "memory.h"
#include "sample_window.h"
#include "simd.h"

namespace torchdof {
namespace {

using namespace constants::edge_colours;  // render/surfaces/edge_colours.py gives meanings, units and effects

constexpr float NO_SCORE = 100.0f;  // marks pixels without a score; above all scores
// weight as a colour reference: far from steps, RINGS pixels from one, ..., beside one; 0 for invalid pixels and ramps
constexpr float SURE_OF[256 / UNSURE] = {SURE[4], SURE[3], SURE[2], SURE[1], SURE[0]};

class Colours : EdgeMap {
 public:
  Colours(const EdgeMap &map, float sharpness) : EdgeMap(map), sharpness_(sharpness) {}

  // For each edge: the score of its surfaces by colour and, if wanted, their nearness.
  void judge(std::vector<Group> &groups, bool wants_surfaces) const {
    // a pixel is not its own reference
    const std::vector<float> falloff =
        window([](float square) { return square > 0 ? std::exp(-square / (2 * FALLOFF_PX * FALLOFF_PX)) : 0.0f; });
    parallel((int)groups.size(), [&](int g) {
      if (groups[g].edges.empty()) return;
      groups[g].judged.resize(groups[g].edges.size());
      groups[g].around.resize((groups[g].edges.size() + LANES - 1) / LANES);
      channels_ == 3 ? judge<3>(groups[g], falloff.data(), wants_surfaces)
                     : judge<0>(groups[g], falloff.data(), wants_surfaces);
    });
  }

  // Averages the scores of neighbours of similar colour, and adds their evidence.
  void decide(std::vector<Group> &groups) {
    parallel((int)groups.size(), [&](int g) {
      Group &group = groups[g];
      if (group.edges.empty()) return;
      const Grid scores(group.bounds.grown(1));
      take_listed(score_, scores, NO_SCORE);
      float beside[9][LANES];  // scores of the 8 neighbours of LANES pixels, and their own
      each_edge(group, [&](size_t k, const Edge &, int y, int x) {
        const int lane = (int)(k % LANES);
        const float *own = scores.at(y, x);
        for (int n = 0; n < 8; n++) beside[n][lane] = own[NEIGHBOURS[n][0] * scores.pitch + NEIGHBOURS[n][1]];
        beside[8][lane] = *own;
        if (lane < LANES - 1 && k + 1 < group.edges.size()) return;
        const float *around = group.around[k / LANES].alike[0];
        const vec none = {};
        vec total = broadcast(1.0f), score = load<vec>(beside[8]), strongest = abs(score);
        for (int n = 0; n < 8; n++) {
          const vec other = load<vec>(beside[n]), alike = other < NO_SCORE ? load<vec>(around + n * LANES) : none;
          total += alike;
          score += alike * other;
          strongest = max(strongest, other < NO_SCORE ? abs(other) : none);
        }
        score /= total;
        for (int l = 0; l <= lane; l++) {
          Judgement &judged = group.judged[k - lane + l];
          judged.score = std::clamp(sharpness_ * judged.reliability * score[l], -MOST_SCORE, MOST_SCORE);
          float &evidence = evidence_[group.edges[k - lane + l].i];
          evidence = std::max(clamp01(2.0f * judged.reliability * strongest[l] - 1.0f), evidence);
        }
      });
    });
  }

 private:
  static float root(float light) {
    return (light <= FINITE) & (light > 0) ? std::sqrt(std::min(light, BRIGHTEST)) : 0.0f;
  }

  // A window around a pixel: weights of both surfaces, nearness, and squared differences to the pixel's colour.
  struct Window {
    vec weights[2][WINDOW], values[WINDOW], apart[WINDOW];
  };

  struct Windows {
    explicit Windows(int count) : values(count * LANES) {}
    Window of_pixel[LANES];
    std::vector<float> values;  // of LANES pixels each: totals of both surfaces, and the pixels' own colours
  };

  // Sums over the windows of some pixels: likelihoods and surfaces, and how alike the pixels around each one are.
  struct Samples {
    float likely[2][LANES], surfaces[2][LANES], blurs[LANES];
    Samples(const Edge *edges, int pixels, const Windows &windows, vec per_spread, bool wants_surfaces, float *around) {
      for (int l = 0; l < pixels; l++) {
        const Window &window = windows.of_pixel[l];
        const float *apart_at = (const float *)window.apart + REACH * WHOLE + REACH;
        for (int n = 0; n < 8; n++) around[n * LANES + l] = apart_at[NEIGHBOURS[n][0] * WHOLE + NEIGHBOURS[n][1]];
        vec parts[6] = {};  // of both surfaces: likelihood, weights, weighted nearness
        for (int n = 0; n < WINDOW; n++) {
          const vec t = 1.0f + window.apart[n] * per_spread[l], alike = 1.0f / (t * t);
          for (int side = 0; side < 2; side++) {
            parts[side] += window.weights[side][n] * alike;
            if (!wants_surfaces) continue;
            const vec part = window.weights[side][n] * (alike + UNLIKE);
            parts[2 + side] += part;
            parts[4 + side] += part * window.values[n];
          }
        }
        blurs[l] = more_blurred(edges[l].near, edges[l].far);
        for (int side = 0; side < 2; side++) {
          likely[side][l] = reduce_add(parts[side]);
          surfaces[side][l] =
              edges[l].near + reduce_add(parts[4 + side]) / std::max(reduce_add(parts[2 + side]), 1e-12f);
        }
      }
    }
  };

  // C: channels, or 0 for any number.
  //
  // The reference colours of a surface are those of the window's pixels whose nearness is within a quarter of the gap.
  // A surface's likelihood is the mean of (1 + d / spread)^-2 over them, d being the squared colour difference.
  //
  // 1. Sum over each pixel's window the weights and colour differences of the references of both surfaces.
  // 2. For LANES pixels at once, compute the spread of the references' colours, and the contrast of the surfaces.
  // 3. Sum the likelihoods over the windows, which need the spread.
  // 4. In maps of the coc, where surfaces are wanted: add the likelihood of a mixture to a more blurred near surface.
  // 5. The score is the logarithm of the likelihoods' ratio, less beside a step with few samples; the reliability grows
  //    with the contrast. A likelihood of LIKELY is full evidence that the pixel shows one of both surfaces.
  template <int C>
  void judge(Group &group, const float *falloff, bool wants_surfaces) const {
    const int channels = C ? C : channels_, count = 4 + 2 * channels;
    const Part around = group.bounds.grown(REACH);
    const Grid given(around), witness(around), colour(around, channels);
    for (int c = 0; c < channels; c++)
      fetch(map_.light + c * area_, colour, colour.at(around.y0, around.x0) + c * colour.size, root);
    fetch(map_.nearness, given, [this](float v) { return sign_ * valid(v); });
    fetch(marks_, witness, [](uint8_t marks) { return (float)(marks / UNSURE); });
    float *sure = witness.at(around.y0, around.x0);
    for (size_t i = 0; i < witness.size; i += LANES) store(sure + i, lookup(SURE_OF, convert(load<vec>(sure + i))));
    std::vector<vec> many(C ? 0 : count);
    Windows windows(count + channels);
    const vec none = {};
    each_edge(group, [&](size_t k, const Edge &edge, int y, int x) {
      const int lane = (int)(k % LANES);
      Window &window = windows.of_pixel[lane];
      const float near = edge.near, far = edge.far;
      const vec most_difference = broadcast(SAMPLED_GAP * std::max(near - far, 1e-12f));
      vec few[C ? 4 + 2 * C : 1];
      // of both surfaces: weights, squared colour differences, colour differences of each channel
      vec *sums = C ? few : many.data();
      float *own = &windows.values[count * LANES + lane];
      for (int n = 0; n < count; n++) sums[n] = none;
      const float *given_at = given.at(y - REACH, x - REACH), *witness_at = witness.at(y - REACH, x - REACH),
                  *colour_at = colour.at(y - REACH, x - REACH);
      for (int c = 0; c < channels; c++) own[c * LANES] = colour_at[c * colour.size + REACH * colour.pitch + REACH];
      each_of_window([&](int n, const auto &take) {
        const vec value = take(given_at, given.pitch),
                  weight = load<vec>(falloff + n * LANES) * take(witness_at, given.pitch), off = value - near;
        const vec w[2] = {abs(off) < most_difference ? weight : none,
                          abs(value - far) < most_difference ? weight : none};
        vec apart = none;  // squared colour difference
        for (int c = 0; c < channels; c++) {
          const vec d = take(colour_at + c * colour.size, given.pitch) - own[c * LANES];
          apart += d * d;
          for (int side = 0; side < 2; side++) sums[4 + 2 * c + side] += w[side] * d;
        }
        for (int side = 0; side < 2; side++) {
          sums[side] += w[side];
          sums[2 + side] += w[side] * apart;
          window.weights[side][n] = w[side];
        }
        window.values[n] = off;
        window.apart[n] = apart;
      });
      for (int n = 0; n < count; n++) windows.values[n * LANES + lane] = reduce_add(sums[n]);
      if (lane == LANES - 1 || k + 1 == group.edges.size())
        score(group, k - lane, lane + 1, windows, channels, wants_surfaces);
    });
  }

  // Steps 2 to 5 of `judge` for up to LANES pixels at once, from pixel `first` of a group on.
  void score(Group &group, size_t first, int pixels, const Windows &windows, int channels, bool wants_surfaces) const {
    const auto of = [&](int n) { return load<vec>(&windows.values[n * LANES]); };
    const int count = 4 + 2 * channels;
    const Separation<vec> s(channels, of, [&](int c) { return of(count + c); });
    float *const around = group.around[first / LANES].alike[0];
    const Samples found(&group.edges[first], pixels, windows, s.per_spread, wants_surfaces, around);
    for (int n = 0; n < 8; n++) store(around + n * LANES, 1.0f / (1.0f + load<vec>(around + n * LANES) * s.per_light));
    const vec mixed = wants_surfaces && map_.is_coc ? s.mixed * load<vec>(found.blurs) : vec{};
    const Likelihoods<vec> likelihoods(s, load<vec>(found.likely[0]), load<vec>(found.likely[1]), mixed,
                                       wants_surfaces ? CLEAR : CLEAR_IN_PRIOR);
    for (int l = 0; l < pixels; l++) {
      const Edge &edge = group.edges[first + l];
      const float odds = std::clamp(std::log(likelihoods.odds[l]), -MOST_ODDS, MOST_ODDS);
      score_[edge.i] = s.is_known[l] ? odds * (marks_[edge.i] & RAMP ? 1.0f : likelihoods.trust[l]) : 0.0f;
      evidence_[edge.i] = likelihoods.evidence[l];
      group.judged[first + l] = {0.0f, s.reliability[l], s.is_known[l] ? found.surfaces[0][l] : edge.near,
                                 s.is_known[l] ? found.surfaces[1][l] : edge.far};
    }
  }

  // Copies a plane where pixels are listed, a constant elsewhere.
  void take_listed(const float *plane, const Grid &grid, float elsewhere) const {
    const Part inside = in_frame(grid);
    for (int y = inside.y0; y < inside.bottom(); y++) {
      float *row = grid.at(y, 0);
      const float *from = plane + pixel(y, 0);
      const uint8_t *marks = marks_ + pixel(y, 0);
      for (int x = inside.x0; x < inside.right(); x++) row[x] = marks[x] & LISTED ? from[x] : elsewhere;
    }
    clamp_to_frame(grid, grid);
  }

  const float sharpness_;
};

}  // namespace

void judge_edges(const EdgeMap &map, std::vector<Group> &groups, bool wants_surfaces, float sharpness) {
  Colours colours(map, sharpness);
  colours.judge(groups, wants_surfaces);
  colours.decide(groups);
}

}  // namespace torchdof
