// Repairs the edges of a depth map: the compiled version of torchdof/render/surfaces/edges.py, with the same constants.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "api.h"
#include "constants/doubt.h"
#include "constants/edge_colours.h"
#include "constants/edge_prior.h"
#include "constants/edges.h"
#include "constants/registration.h"
#include "edge_colours.h"
#include "edge_map.h"
#include "edge_rules.h"
#include "edge_search.h"
#include "entry.h"
#include "memory.h"
#include "simd.h"
#include "soft_maps.h"

namespace torchdof {
namespace {

using namespace constants::edge_prior;
using namespace constants::edges;  // render/surfaces/edges.py gives meanings, units and effects
using constants::doubt::ASSUMED, constants::doubt::CONTRADICTED, constants::doubt::OFTEN_CONTRADICTED;
using constants::edge_colours::SHARPNESS, constants::edge_colours::SOFT_SHARPNESS;
using constants::edge_search::LEVELS;
using constants::registration::DILATED, constants::registration::ONE_SIDE, constants::registration::RESIZED,
    constants::registration::SHIFTED, constants::registration::SIDES, constants::registration::THIN;

// Weights of the clearest edge pixels of far surfaces and of near ones, and of those that have the right colour: of
// all, and by direction.
struct Agreement {
  struct Weights {
    double clear[2] = {}, agreed[2] = {};
  } all, by[DIRECTIONS];
};

// Planes of all pixels.
struct Planes {
  explicit Planes(size_t area) : score(area), evidence(area), marks(area) {}
  const Buffer<float> score, evidence;
  const Buffer<uint8_t> marks;
};

enum Result { UNCHANGED, CHANGED, STOPPED };

class Repair : Planes, EdgeMap {
 public:
  explicit Repair(const torchdof_map &map)
      : Planes((size_t)map.height * map.width), EdgeMap(map, score.data(), evidence.data(), marks.data()) {
    noise_step_ = NOISES * noise_of(map);
  }

  // 1. Find the edges of a sample of the frame, see whether the map is soft, and decide by colour which surface each
  //    pixel shows.
  // 2. Calibrate: for each kind of edge pixel, the share that shows the near surface.
  // 3. In automatic mode stop here if the map is exact or its edges are unrelated to the image's.
  // 4. Find and decide the edges of the whole frame; move pixels that have the depth of the wrong surface.
  // 5. In a soft map also remove ringing, and restore the nearness of small lamps that a blur has reduced.
  // Returns whether the map has changed, or that it stopped because of its ramps; doubt: how much the image contradicts
  // a soft map, 0 to 1, less how far foregrounds are dilated, 0 to 1; edits: bits of those that colours ask for.
  Result run(double &doubt, int &edits) {
    doubt = edits = 0;
    const int every = (int)std::ceil(std::sqrt((double)area_ / SAMPLED));
    // where the sample is a small part of the frame, only its edges are found first
    const bool finds_twice = map_.automatic && every > 4;
    const auto is_sampled = [&](int y, int x) { return (block_of(y, height_) + block_of(x, width_)) % every == 0; };
    std::vector<Group> groups = tiles(), sampled;
    KindMask all_kinds;
    all_kinds.fill(true);
    if (finds_twice) {
      sampled = blocks(is_sampled);
      find_edges(*this, sampled, REACH, false, false, all_kinds);
    } else {
      found_ = find_edges(*this, groups, 0, false, true, all_kinds);
      sampled = groups;
    }
    // blocks and tiles contain edge pixels that are not sampled
    choose_edges(sampled, [&](const Edge &edge) { return is_sampled(edge.i / width_, edge.i % width_); });
    const double softness = softness_of(sampled);
    const bool is_soft = softness > 1;
    if (map_.stops_if_wide && softness > WIDE) return STOPPED;
    const float sharpness = is_soft ? SOFT_SHARPNESS : SHARPNESS;
    judge_edges(*this, sampled, false, sharpness);
    calibrate(sampled);
    const Agreement agreement = agreement_of(sampled);
    float dilated = 0.0f;
    if (map_.automatic) {
      const Edits asked = edits_of(agreement, is_soft);
      edits = asked.bits;
      dilated = is_soft && map_.eroded ? 1.0f : asked.dilated;
      if (edits & map_.stops) return UNCHANGED;
      if (!(map_.is_related || edits || is_related(agreement)) || !(is_soft || is_inexact(sampled))) return UNCHANGED;
    }
    parallel(height_,
             [&](int y) { memcpy(map_.out + pixel(y, 0), map_.nearness + pixel(y, 0), width_ * sizeof(float)); });
    const KindMask doubtful = map_.automatic ? doubtful_kinds(is_soft) : all_kinds;
    if (finds_twice)
      found_ = find_edges(*this, groups, 0, is_soft, is_soft, doubtful);
    else
      choose_edges(groups, [&](const Edge &edge) { return doubtful[given_kind_of(edge)]; });
    judge_edges(*this, groups, true, sharpness);
    // ramps of a pixel are means over pixels, or artefacts of compression: there is little to doubt
    const float in_doubt = map_.automatic && is_soft ? doubt_of(agreement) * (1.0f - dilated) : 0.0f,
                faded = in_doubt * clamp01((float)softness - 1.0f);
    const float lost_px = move(groups, is_soft, faded, dilated);
    if (is_soft) remove_ringing(*this);
    if (is_soft && faded < 1) lift_lamps(*this, sigma_of(found_), lost_px, faded);
    doubt = faded - dilated;
    return CHANGED;
  }

 private:
  // Kind of an edge pixel, plus KINDS if the map gives it the near surface: an index into a KindMask.
  int given_kind_of(const Edge &edge) const { return edge.kind + (marks_[edge.i] & NEAR ? KINDS : 0); }
  // Share of the pixels of a given kind to which the map gives the wrong surface.
  float wrong(int given_kind) const {
    return given_kind >= KINDS ? 1.0f - shares_[given_kind - KINDS] : shares_[given_kind];
  }

  static float gap_of(const Edge &edge) { return std::max(edge.near - edge.far, 1e-12f); }
  // Place of an edge pixel between its two surfaces, 0 (far) to 1 (near).
  float level_of(const Edge &edge) const { return clamp01((nearness(edge.i) - edge.far) / gap_of(edge)); }

  // How often pixels of the sampled edges are far from both surfaces, by _mixture of render/surfaces/edges.py; a map is
  // soft from 1.
  double softness_of(const std::vector<Group> &sampled) const {
    double mixed = 0, length = 0;
    for (const Group &group : sampled)
      each_edge(group, [&](size_t, const Edge &edge, int y, int x) {
        const float *value = map_.nearness + edge.i, level = level_of(edge), mixture = 4.0f * level * (1.0f - level);
        if (marks_[edge.i] & RAMP) mixed += mixture * mixture * mixture;
        length += climb(value, x > 0 ? -1 : 0, x < width_ - 1 ? 1 : 0, y > 0 ? -width_ : 0,
                        y < height_ - 1 ? width_ : 0, gap_of(edge));
      });
    return mixed / (SOFT * std::max(length, 1e-12));
  }

  // Whether more of the sampled step pixels are wrong than in an exact map.
  bool is_inexact(const std::vector<Group> &sampled) const {
    double found = 0, steps = 0;
    for (const Group &group : sampled)
      for (const Edge &edge : group.edges)
        if (!(marks_[edge.i] & RAMP)) {
          found += wrong(given_kind_of(edge));
          steps++;
        }
    return found > EXACT * steps;
  }

  // Block index of a row or column, counted from the nearest border so that mirroring the frame keeps it.
  static int block_of(int at, int size) { return std::min(at, size - 1 - at) / BLOCK; }

  // The selected blocks of BLOCK pixels.
  template <typename Wanted>
  std::vector<Group> blocks(const Wanted &wanted) const {
    struct Run {
      int start, size;
    };
    const auto along = [&](int size) {
      std::vector<Run> runs;
      for (int start = 0; start < (size + 1) / 2; start += BLOCK) {
        const int near = std::min(BLOCK, (size + 1) / 2 - start), far = std::min(BLOCK, size / 2 - start);
        runs.push_back({start, near});
        if (far > 0) runs.push_back({size - start - far, far});
      }
      return runs;
    };
    std::vector<Group> parts;
    for (const Run &y : along(height_))
      for (const Run &x : along(width_))
        if (wanted(y.start, x.start)) parts.push_back({{y.start, x.start, y.size, x.size}});
    return parts;
  }

  // The kinds of pixels to decide in automatic mode: steps of kinds that are often wrong, and ramps if the map is soft.
  KindMask doubtful_kinds(bool is_soft) const {
    KindMask selected;
    for (int kind = 0; kind < 2 * KINDS; kind++)
      selected[kind] = kind % KINDS / DIRECTIONS >= 2 * RINGS ? is_soft : wrong(kind) > DOUBTFUL;
    return selected;
  }

  // Keeps the chosen edges and clears the mark of the others.
  template <typename Chosen>
  void choose_edges(std::vector<Group> &groups, const Chosen &chosen) {
    parallel((int)groups.size(), [&](int g) {
      Group &group = groups[g];
      size_t kept = 0;
      for (const Edge &edge : group.edges) {
        const bool is_listed = chosen(edge);
        marks_[edge.i] = (uint8_t)((marks_[edge.i] & ~LISTED) | (is_listed ? LISTED : 0));
        if (is_listed) group.edges[kept++] = edge;
      }
      group.edges.resize(kept);
      group.bounds = bounds(group);
    });
  }

  // How far colours agree with the map at pixels where the map is most likely right.
  Agreement agreement_of(const std::vector<Group> &groups) const {
    Agreement found;
    for (const Group &group : groups)
      for (size_t k = 0; k < group.edges.size(); k++) {
        const Edge &edge = group.edges[k];
        const float score = group.judged[k].score, level = level_of(edge);
        if (marks_[edge.i] & RAMP ? std::fabs(level - 0.5f) <= CLEAR_LEVEL
                                  : edge.kind / DIRECTIONS % RINGS != RINGS - 1)
          continue;
        const float weight = weight_of(score);
        const bool is_near = level > 0.5f;
        for (Agreement::Weights *sums : {&found.all, &found.by[edge.kind % DIRECTIONS]}) {
          sums->clear[is_near] += weight;
          if ((score > 0) == is_near) sums->agreed[is_near] += weight;
        }
      }
    return found;
  }

  // Whether they do on one side of its edges at least, because beside a foreground that is too thin they show the
  // foreground.
  static bool is_related(const Agreement &found) {
    const float assumed = 0.5f * PRIOR_COUNT;  // pixels, half of which agree
    const auto agrees = [&](bool side) {
      return (found.all.agreed[side] + 0.5f * assumed) / (found.all.clear[side] + assumed) > RELATED;
    };
    return agrees(false) || agrees(true);
  }

  struct Edits {
    int bits;
    float dilated;
  };

  // render/surfaces/doubt.py, contradicted: of the near side, or the far one.
  static float contradicted(const Agreement::Weights &found, bool side) {
    return (float)((found.clear[side] - found.agreed[side]) / (found.clear[side] + ASSUMED));
  }

  // render/surfaces/doubt.py, doubt_of.
  static float doubt_of(const Agreement &found) {
    const float share = std::min(contradicted(found.all, true), contradicted(found.all, false));
    return clamp01((share - CONTRADICTED) / (OFTEN_CONTRADICTED - CONTRADICTED));
  }

  // render/surfaces/registration.py, edits_of: a bit for each edit, and how far foregrounds of a soft map are dilated.
  Edits edits_of(const Agreement &found, bool is_soft) const {
    float beside[DIRECTIONS], apart[DIRECTIONS], least_far = 1;
    for (int d = 0; d < DIRECTIONS; d++) {
      float share = 0;
      for (int level = 0; level < LEVELS; level++) share += shares_[(2 * RINGS + level) * DIRECTIONS + d];
      beside[d] = is_soft ? 2.0f * share / LEVELS - 1.0f : shares_[d] + shares_[RINGS * DIRECTIONS + d] - 1.0f;
      apart[d] = contradicted(found.by[d], false) - contradicted(found.by[d], true);
      least_far = std::min(least_far, shares_[d]);
    }
    const auto [least, most] = std::minmax_element(beside, beside + DIRECTIONS);
    const float clear = contradicted(found.all, false) - contradicted(found.all, true);
    const bool is_thin = *least > RESIZED || (clear > THIN && (is_soft || least_far > constants::registration::BESIDE)),
               is_wide = (-clear > constants::registration::WIDE && *most < RESIZED) || (!is_soft && *most < -RESIZED);
    int edits = is_thin + 2 * is_wide;
    for (int k = 0; k < (int)std::size(SIDES); k++) {
      const int side = SIDES[k], other = DIRECTIONS - 1 - side;
      const auto moves = [&](const float *excess) {
        const float outward = excess[side], inward = -excess[other];
        return std::min(outward, inward) > ONE_SIDE && 0.5f * (outward + inward) > SHIFTED;
      };
      if (moves(beside) || moves(apart)) edits |= 4 << k;
    }
    return {edits, is_soft ? clamp01((-*most - DILATED) / (RESIZED - DILATED)) : 0.0f};
  }

  // Share of pixels that show the near surface, by kind: a maximum-likelihood fit (EM) to the scores, with PRIOR_COUNT
  // pixels assumed at the share that an almost exact map has.
  void calibrate(const std::vector<Group> &groups) {
    std::vector<float> assumed(PLACES), start(PLACES);
    for (int p = 0; p < PLACES; p++) {
      assumed[p] = assumed_share(p);
      start[p] = first_share(p);
    }
    std::vector<Observations> observations(KINDS);
    for (const Group &group : groups)
      for (size_t k = 0; k < group.edges.size(); k++) {
        const float score = group.judged[k].score;
        Observations &observed = observations[group.edges[k].kind];
        observed.weights.push_back(weight_of(score));
        observed.odds.push_back(std::exp(-score));
      }
    for (Observations &observed : observations)
      for (std::vector<float> *values : {&observed.weights, &observed.odds})
        values->resize((values->size() + LANES - 1) / LANES * LANES);
    const std::vector<float> together = fit(observations, DIRECTIONS, start, assumed);
    std::vector<float> each(KINDS);
    for (int k = 0; k < KINDS; k++) each[k] = together[k / DIRECTIONS];
    shares_ = fit(observations, 1, std::vector<float>(KINDS, 0.5f), each);
  }

  // Scores of the pixels of one kind: weight, and odds of the far surface. Padded to whole vectors with weight 0.
  struct Observations {
    std::vector<float> weights, odds;
  };

  static std::vector<float> fit(const std::vector<Observations> &observations, int together, std::vector<float> share,
                                const std::vector<float> &assumed) {
    const auto sum_of = [&](size_t first, const auto &part) {
      double totals[LANES] = {}, total = 0;
      for (size_t kind = first; kind < first + together; kind++)
        for (size_t n = 0; n < observations[kind].weights.size(); n += LANES) {
          float parts[LANES];
          store(parts, part(load<vec>(&observations[kind].weights[n]), load<vec>(&observations[kind].odds[n])));
          for (int i = 0; i < LANES; i++) totals[i] += parts[i];
        }
      for (const double each : totals) total += each;
      return total;
    };
    for (size_t g = 0; g < share.size(); g++) {
      const double total = sum_of(g * together, [](vec weight, vec) { return weight; });
      for (int round = 0; round < ROUNDS; round++)
        share[g] = next_share(share[g], total, assumed[g], [&](float odds) {
          return sum_of(g * together, [&](vec weight, vec other) { return weight / (1.0f + odds * other); });
        });
    }
    return share;
  }

  // Decides which surface pixels show, and moves them to its nearness; on ramps in proportion to the evidence, or to
  // the doubt. Returns the width, in pixels, by which the map's near surfaces are too thin.
  float move(const std::vector<Group> &groups, bool is_soft, float doubt, float dilated) const {
    const float lean = map_.automatic ? (1.0f - dilated) * LEAN : 0.0f,
                to_blurred = map_.automatic && map_.is_coc && is_soft ? TO_BLURRED : 0.0f;
    float prior[KINDS];
    for (int k = 0; k < KINDS; k++) prior[k] = std::log(shares_[k] / (1.0f - shares_[k]));
    const auto odds = [&](const Group &group, size_t k) {
      const float score = group.judged[k].score, undecided = 1.0f - dilated * std::min(SCORED * std::fabs(score), 1.0f);
      const Edge &edge = group.edges[k];
      return score + prior[edge.kind] + lean * clamp01(std::fabs(score) - 1.0f) +
             to_blurred * undecided * more_blurred(edge.near, edge.far);
    };
    if (is_soft)  // the chances that pixels show the near surface
      parallel((int)groups.size(), [&](int g) {
        for (size_t k = 0; k < groups[g].edges.size(); k++)
          score_[groups[g].edges[k].i] = 1.0f / (1.0f + std::exp(-odds(groups[g], k)));
      });
    std::vector<int64_t> lost(groups.size(), 0);
    parallel((int)groups.size(), [&](int g) {
      for (size_t k = 0; k < groups[g].edges.size(); k++) {
        const Edge &edge = groups[g].edges[k];
        const Judgement &judged = groups[g].judged[k];
        const bool shows_near = odds(groups[g], k) + (is_soft ? neighbours(edge) : 0.0f) > 0;
        const uint8_t marks = marks_[edge.i];
        const bool was_near = marks & NEAR;
        lost[g] += shows_near - was_near;
        const float moved = !(marks & RAMP) ? (float)(shows_near != was_near) : std::max(evidence_[edge.i], doubt);
        if (!(moved > 0)) continue;
        const float own = nearness(edge.i), surface = shows_near ? judged.near : judged.far;
        map_.out[edge.i] = sign_ * (own + moved * (surface - own));
      }
    });
    double total = found_.lost;
    for (const int64_t here : lost) total += (double)here;
    return (float)(total / std::max(found_.length, 1e-12));
  }

  // Log-odds of the near surface from the neighbours; score_ is the chance that a listed one shows it.
  float neighbours(const Edge &edge) const {
    float odds = 0;
    for (const auto &[dy, dx] : NEIGHBOURS) {
      const int at =
          std::clamp(edge.i / width_ + dy, 0, height_ - 1) * width_ + std::clamp(edge.i % width_ + dx, 0, width_ - 1);
      const bool is_near = sign_ * valid(map_.nearness[at]) > 0.5f * (edge.near + edge.far);
      odds += (dy && dx ? DIAGONAL : BESIDE) * (2.0f * (marks_[at] & LISTED ? score_[at] : (float)is_near) - 1.0f);
    }
    return odds;
  }

  std::vector<float> shares_;
  EdgeSums found_;
};

}  // namespace
}  // namespace torchdof

int32_t torchdof_repair_edges(const torchdof_map *map, int32_t *changed, double *doubt, int32_t *edits) {
  return torchdof::guarded([&] { *changed = torchdof::Repair(*map).run(*doubt, *edits); });
}
