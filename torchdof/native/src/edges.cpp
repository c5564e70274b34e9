// Depth edges: what torchdof/depth/edges.py states, compiled. Names and constants are that file's.
#include <algorithm>
#include <cmath>
#include <vector>

#include "engine.h"
#include "variants.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

constexpr int RINGS = 3, REACH = 5, RAMP_REACH = 6, LEVELS = 6, PLACES = 2 * RINGS + LEVELS, KINDS = 4 * PLACES, ROUNDS = 10;
constexpr float SURE[RINGS + 2] = {0.0f, 0.02f, 0.06f, 0.2f, 1.0f};
constexpr float ABRUPT = 0.3f, SHALLOW = 0.03f, TRUSTED = 0.05f, PRIOR_COUNT = 30.0f, EXACT = 0.05f, RELATED = 0.8f, SOFT = 0.1f, SHARPNESS = 1.6f, MOST = 4.0f;
constexpr int SAMPLED = 1 << 17, SAMPLE_BLOCK = 32, BLUR_REACH = 9;
constexpr int AREA = 64;
constexpr int HALO = 21, STEP_HALO = RINGS + REACH;  // what a pixel shows depends on what is so far around it; without ramps
constexpr float NONE = 1e30f;
constexpr float LARGEST = 3.402823466e38f;
constexpr int FLAT_REACH = 8, PLANES = 7 + 3 + 3 * RINGS;
constexpr int SIDE = 2 * REACH + 1, WINDOW = SIDE * SIDE, ROOM = (WINDOW + LANES - 1) / LANES * LANES;

// A part of the frame and its surroundings, as far as the frame goes.
struct Part {
  int y0, x0, height, width;
};

using Plane = std::vector<float>;

// Each value becomes the larger of two; where `from` overlaps `to` it lies behind it.
void raise(float *to, const float *from, int count) {
  int x = 0;
  for (; x + LANES <= count; x += LANES) store(to + x, most(load<vec>(to + x), load<vec>(from + x)));
  for (; x < count; x++) to[x] = to[x] < from[x] ? from[x] : to[x];
}

// The largest of 2 reach + 1 values, in place: of 2, of 4, ... and of two such that overlap.
template <typename Merge>
void widen(int reach, const Merge &merge) {
  int covered = 1;
  for (; 2 * covered <= 2 * reach + 1; covered *= 2) merge(covered);
  if (covered < 2 * reach + 1) merge(2 * reach + 1 - covered);
}

// The largest of a square around each value; rows: scratch of height + 2 reach times width + 2 reach.
void highest(const float *in, float *out, float *rows, int height, int width, int reach) {
  const int wide = width + 2 * reach;
  std::fill(rows, rows + (size_t)reach * wide, -NONE);
  std::fill(rows + (size_t)(height + reach) * wide, rows + (size_t)(height + 2 * reach) * wide, -NONE);
  for (int y = 0; y < height; y++) {
    float *to = rows + (size_t)(y + reach) * wide;
    std::fill(to, to + reach, -NONE);
    memcpy(to + reach, in + (size_t)y * width, width * sizeof(float));
    std::fill(to + reach + width, to + wide, -NONE);
    int length = wide;
    widen(reach, [&](int by) {
      length -= by;
      raise(to, to + by, length);
    });
  }
  int count = height + 2 * reach;
  widen(reach, [&](int by) {
    count -= by;
    for (int y = 0; y < count; y++) raise(rows + (size_t)y * wide, rows + (size_t)(y + by) * wide, width);
  });
  for (int y = 0; y < height; y++) memcpy(out + (size_t)y * width, rows + (size_t)y * wide, width * sizeof(float));
}

// The mean of a square around each value, which goes on beyond the border as it is at it.
void mean(const float *in, float *out, float *rows, int height, int width, int reach) {
  const float share = 1.0f / (2 * reach + 1);
  for (int y = 0; y < height; y++) {
    const float *from = in + (size_t)y * width;
    float *to = rows + (size_t)y * width;
    const int first = std::min(reach, width), last = std::max(first, width - reach);
    for (int x = 0; x < width; x++) to[x] = 0.0f;
    for (int d = -reach; d <= reach; d++) {
      for (int x = 0; x < first; x++) to[x] += from[std::min(std::max(x + d, 0), width - 1)];
      for (int x = first; x < last; x++) to[x] += from[x + d];
      for (int x = last; x < width; x++) to[x] += from[std::min(std::max(x + d, 0), width - 1)];
    }
    for (int x = 0; x < width; x++) to[x] *= share;
  }
  for (int y = 0; y < height; y++) {
    float *to = out + (size_t)y * width;
    std::fill(to, to + width, 0.0f);
    for (int d = -reach; d <= reach; d++) {
      const float *from = rows + (size_t)std::min(std::max(y + d, 0), height - 1) * width;
      for (int x = 0; x < width; x++) to[x] += from[x] * share;
    }
  }
}

float sum(vec v) {
  float total = 0;
  for (int i = 0; i < LANES; i++) total += v[i];
  return total;
}

float logit(float p) { return std::log(p / (1.0f - p)); }

struct Judgement {
  float score, tells, near, far;
};

class Repair {
 public:
  explicit Repair(const torchdof_map &map)
      : map_(map), height_(map.height), width_(map.width), channels_(map.channels), area_((size_t)map.height * map.width) {}

  void run() {
    parallel(height_, [&](int y) {
      memcpy(map_.out + (size_t)y * width_, map_.nearness + (size_t)y * width_, width_ * sizeof(float));
    });
    allocate();
    const int every = (int)(((int64_t)area_ + SAMPLED - 1) / SAMPLED);
    const bool spares = map_.automatic && every > 4;  // blocks of a sample are apart, and a look at them alone may do
    spares ? find_sample(every) : find();
    const std::vector<int> sampled = sample(every);
    std::vector<Judgement> judged = judge(sampled);
    std::vector<float> evidence;
    decide(sampled, judged, evidence);
    calibrate(sampled, judged);
    int64_t ramps = 0;
    for (const int i : sampled) ramps += ramp_[i];
    bool is_soft = (double)ramps > SOFT * (double)sampled.size();
    if (map_.automatic && (!is_related(sampled, judged) || !(is_soft || is_inexact(sampled)))) return;
    if (spares) find();
    const std::vector<int> pixels = list([&](size_t i) { return !map_.automatic || (ramp_[i] ? is_soft : wrong(i) > EXACT); });
    if (pixels.empty() && !is_soft) return;
    judged = judge(pixels);
    decide(pixels, judged, evidence);
    std::vector<uint8_t> shows(pixels.size());
    for (size_t k = 0; k < pixels.size(); k++) shows[k] = judged[k].score + logit(shares_[kind_[pixels[k]]]) > 0;
    const float sigma = blur();
    unmix(pixels, shows, sigma, judged);
    for (size_t k = 0; k < pixels.size(); k++) {
      const size_t i = pixels[k];
      const float moved = ramp_[i] ? evidence[k] : (float)((bool)shows[k] != is_near(i));
      const float to = shows[k] ? judged[k].near : judged[k].far;
      if (moved > 0) map_.out[i] = given_[i] + moved * (to - given_[i]);
    }
    if (is_soft) lift_lamps(sigma);
  }

 private:
  template <typename Body>
  void parallel(int count, const Body &body) const {
    torchdof::parallel(map_.threads, count, map_.cancelled, [&](int i, int) { body(i); });
  }

  float step(size_t i) const { return map_.steps ? map_.steps[i] : map_.step; }
  bool is_near(size_t i) const { return 2.0f * given_[i] > near_[i] + far_[i]; }
  float wrong(size_t i) const { return is_near(i) ? 1.0f - shares_[kind_[i]] : shares_[kind_[i]]; }

  // Whether more of a sample's pixels at steps are wrong than exact maps have.
  bool is_inexact(const std::vector<int> &sampled) const {
    double found = 0, steps = 0;
    for (const int i : sampled)
      if (!ramp_[i]) {
        found += wrong(i);
        steps++;
      }
    return found > EXACT * steps;
  }

  template <typename Chosen>
  std::vector<int> list(const Chosen &chosen) const {
    std::vector<int> found;
    for (size_t i = 0; i < area_; i++)
      if (edge_[i] && chosen(i)) found.push_back((int)i);
    return found;
  }

  // Calls body(top, left, bottom, right) for each block of a sample.
  template <typename Body>
  void each_sampled(int every, const Body &body) const {
    for (int y = 0; y * SAMPLE_BLOCK < height_; y++)
      for (int x = 0; x * SAMPLE_BLOCK < width_; x++)
        if ((y + 3 * x) % every == 0)
          body(y * SAMPLE_BLOCK, x * SAMPLE_BLOCK, std::min(height_, (y + 1) * SAMPLE_BLOCK), std::min(width_, (x + 1) * SAMPLE_BLOCK));
  }

  std::vector<int> sample(int every) const {
    std::vector<int> found;
    each_sampled(every, [&](int top, int left, int bottom, int right) {
      for (int y = top; y < bottom; y++)
        for (int x = left; x < right; x++)
          if (const size_t i = (size_t)y * width_ + x; edge_[i]) found.push_back((int)i);
    });
    return found;
  }

  void allocate() {
    given_ = Buffer<float>(area_);
    colour_ = Buffer<float>(area_ * channels_);
    near_ = Buffer<float>(area_);
    far_ = Buffer<float>(area_);
    witness_ = Buffer<float>(area_);
    edge_ = Buffer<uint8_t>(area_);
    ramp_ = Buffer<uint8_t>(area_);
    kind_ = Buffer<uint8_t>(area_);
  }

  void take(const Part &part) {
    for (int y = part.y0; y < part.y0 + part.height; y++) {
      const size_t from = (size_t)y * width_ + part.x0, to = from + part.width;
      for (size_t i = from; i < to; i++) {
        const float v = map_.nearness[i];
        const bool valid = std::fabs(v) <= LARGEST;
        given_[i] = valid ? v : 0.0f;
        witness_[i] = valid ? 1.0f : 0.0f;
      }
      memset(edge_.data() + from, 0, part.width);
      memset(ramp_.data() + from, 0, part.width);
    }
  }

  void take_colours(const Part &part) {
    for (int y = part.y0; y < part.y0 + part.height; y++)
      for (int c = 0; c < channels_; c++) {
        const size_t from = (size_t)y * width_ + part.x0;
        const float *light = map_.light + c * area_ + from;
        float *to = colour_.data() + from * channels_ + c;
        for (int x = 0; x < part.width; x++) to[(size_t)x * channels_] = light[x] <= LARGEST && light[x] > 0 ? std::sqrt(light[x]) : 0.0f;
      }
  }

  Part around(int top, int left, int bottom, int right, int reach) const {
    const int y0 = std::max(0, top - reach), x0 = std::max(0, left - reach);
    return {y0, x0, std::min(height_, bottom + reach) - y0, std::min(width_, right + reach) - x0};
  }

  // Ramps and steps, and the two surfaces that meet there.
  void find() {
    const int rows = ceil_div(height_, AREA), columns = ceil_div(width_, AREA), parts = rows * columns;
    std::vector<double> steepness(parts, 0.0);
    std::vector<int64_t> middles(parts, 0);
    parallel(parts, [&](int p) {
      const int top = p / columns * AREA, left = p % columns * AREA;
      const Part inner = around(top, left, top + AREA, left + AREA, 0);
      take_colours(inner);
      find_in(inner, steepness[p], middles[p]);
    });
    for (int p = 0; p < parts; p++) {
      steepness_ += steepness[p];
      middles_ += middles[p];
    }
  }

  // The same, in the blocks of a sample and what is around them.
  void find_sample(int every) {
    std::vector<Part> blocks;
    each_sampled(every, [&](int top, int left, int bottom, int right) { blocks.push_back(around(top, left, bottom, right, REACH)); });
    parallel((int)blocks.size(), [&](int p) {
      double steepness;
      int64_t middles;
      if (find_in(blocks[p], steepness, middles)) take_colours(blocks[p]);
    });
  }

  // The largest change between neighbours in a part.
  float changes(const Part &part) const {
    Buffer<float> most(part.width);
    std::fill(most.data(), most.data() + part.width, 0.0f);
    for (int y = part.y0; y < part.y0 + part.height; y++) {
      const float *at = map_.nearness + (size_t)y * width_ + part.x0, *above = y > part.y0 ? at - width_ : at;
      for (int x = 0; x < part.width - 1; x++) {
        const float change = std::fabs(at[x + 1] - at[x]), down = std::fabs(at[x] - above[x]);
        most[x] = most[x] < change ? change : most[x];
        most[x] = most[x] < down ? down : most[x];
      }
      const float down = std::fabs(at[part.width - 1] - above[part.width - 1]);
      most[part.width - 1] = std::max(most[part.width - 1], down);
    }
    return *std::max_element(most.data(), most.data() + part.width);
  }

  float least_step(const Part &part) const {
    if (!map_.steps) return map_.step;
    float least = NONE;
    for (int y = part.y0; y < part.y0 + part.height; y++)
      for (int x = part.x0; x < part.x0 + part.width; x++) least = std::min(least, step((size_t)y * width_ + x));
    return least;
  }

  // Returns whether there may be edges.
  bool find_in(const Part &inner, double &steepness, int64_t &middles) {
    take(inner);
    const int bottom = inner.y0 + inner.height, right = inner.x0 + inner.width;
    const Part part = around(inner.y0, inner.x0, bottom, right, STEP_HALO);
    if (!(changes(part) > 0.09f * least_step(part))) return false;
    if (!find_in(inner, part, false, steepness, middles))
      find_in(inner, around(inner.y0, inner.x0, bottom, right, HALO), true, steepness, middles);
    return true;
  }

  // Returns whether the part was enough of what is around.
  bool find_in(const Part &inner, const Part &part, bool wide_enough, double &steepness, int64_t &middles) {
    const int h = part.height, w = part.width;
    const size_t size = (size_t)h * w;
    const auto at = [&](int y, int x) { return (size_t)(part.y0 + y) * width_ + part.x0 + x; };
    const size_t padded = (size_t)(h + 2 * FLAT_REACH) * (w + 2 * FLAT_REACH);
    Buffer<float> planes(PLANES * size + padded + 2 * (h + 1) * (w + 1));
    Buffer<uint8_t> marks(2 * size);
    float *next = planes.data();
    const auto plane = [&] {
      float *taken = next;
      next += size;
      return taken;
    };
    float *value = plane(), *up = plane(), *down = plane(), *slope = plane(), *jump = plane(), *a = plane(), *b = plane();
    float *rows = planes.data() + PLANES * size;
    float *across = rows + padded, *along = across + (size_t)(h + 1) * (w + 1);  // changes from the left and from above
    uint8_t *ok = marks.data(), *ramp = ok + size;
    for (int y = 0; y < h; y++)
      for (int x = 0; x < w; x++) {
        const size_t k = (size_t)y * w + x;
        const float v = map_.nearness[at(y, x)];
        ok[k] = std::fabs(v) <= LARGEST;
        value[k] = ok[k] ? v : 0.0f;
        up[k] = ok[k] ? v : -NONE;
        down[k] = ok[k] ? -v : -NONE;
      }
    const int wide = w + 1;
    std::fill(across, across + 2 * (size_t)(h + 1) * wide, 0.0f);
    const auto known = [](float change) { return std::fabs(change) <= LARGEST ? change : 0.0f; };
    for (int y = 0; y < h; y++) {
      const float *at_row = map_.nearness + at(y, 0), *above = at_row - (y > 0 ? width_ : 0);
      float *to_across = across + (size_t)y * wide, *to_along = along + (size_t)y * wide;
      for (int x = 1; x < w; x++) to_across[x] = known(at_row[x] - at_row[x - 1]);
      for (int x = 0; x < w; x++) to_along[x] = known(at_row[x] - above[x]);
    }
    for (int y = 0; y < h; y++) {
      const float *x0 = across + (size_t)y * wide, *x1 = x0 + 1, *y0 = along + (size_t)y * wide, *y1 = y0 + wide;
      float *to_slope = slope + (size_t)y * w, *to_jump = jump + (size_t)y * w;
      for (int x = 0; x < w; x++) {
        const float ax0 = std::fabs(x0[x]), ax1 = std::fabs(x1[x]), ay0 = std::fabs(y0[x]), ay1 = std::fabs(y1[x]);
        const float lx = ax0 < ax1 ? ax0 : ax1, ly = ay0 < ay1 ? ay0 : ay1, mx = ax0 < ax1 ? ax1 : ax0, my = ay0 < ay1 ? ay1 : ay0;
        const float sx = x0[x] * x1[x] > 0 ? lx : 0.0f, sy = y0[x] * y1[x] > 0 ? ly : 0.0f, jx = mx - sx, jy = my - sy;
        to_slope[x] = sx < sy ? sy : sx;
        to_jump[x] = jx < jy ? jy : jx;
      }
    }
    highest(up, a, rows, h, w, REACH);
    highest(down, b, rows, h, w, REACH);
    // ramps no farther away than this reach into the inner part
    const int top = inner.y0 - part.y0, left = inner.x0 - part.x0, bottom = top + inner.height, right = left + inner.width;
    bool any = false;
    for (int y = 0; y < h; y++) {
      const size_t k = (size_t)y * w;
      bool any_here = false;
      const bool is_close = y >= top - RINGS && y < bottom + RINGS;
      for (int x = 0; x < w; x++) {
        const float span = a[k + x] + b[k + x], s = map_.steps ? map_.steps[at(y, x)] : map_.step;
        const bool is_ramp = (slope[k + x] > 0.1f * s) & (slope[k + x] > SHALLOW * span) & (span > s) & (ok[k + x] != 0);
        ramp[k + x] = is_ramp;
        any_here |= is_ramp & (x >= left - RINGS) & (x < right + RINGS);
      }
      any |= any_here && is_close;
    }
    if (any && !wide_enough) return false;
    if (any) {  // a ramp ends, a slope goes on
      float *flat = plane(), *up_end = plane(), *down_end = plane();
      mean(slope, flat, rows, h, w, 2);
      for (size_t k = 0; k < size; k++) flat[k] = -flat[k];
      highest(flat, a, rows, h, w, FLAT_REACH);
      for (size_t k = 0; k < size; k++) ramp[k] &= -a[k] < 0.3f * slope[k];
      // the surfaces at both ends of a ramp
      memcpy(up_end, up, size * sizeof(float));
      memcpy(down_end, down, size * sizeof(float));
      for (int round = 0; round < RAMP_REACH; round++) {
        highest(up_end, a, rows, h, w, 1);
        highest(down_end, b, rows, h, w, 1);
        for (size_t k = 0; k < size; k++) {
          up_end[k] = ramp[k] ? a[k] : up_end[k];
          down_end[k] = ramp[k] ? b[k] : down_end[k];
        }
      }
      for (int y = 0; y < h; y++)
        for (int x = 0; x < w; x++) {
          const size_t k = (size_t)y * w + x;
          ramp[k] &= up_end[k] + down_end[k] > step(at(y, x));
          if (ramp[k]) {
            up[k] = up_end[k];
            down[k] = down_end[k];
          }
        }
    } else {
      memset(ramp, 0, size);
    }
    // those at both sides of a step
    float *nears[RINGS], *fars[RINGS], *jumps[RINGS];
    for (int r = 0; r < RINGS; r++) {
      nears[r] = plane();
      fars[r] = plane();
      jumps[r] = plane();
      highest(r ? nears[r - 1] : up, nears[r], rows, h, w, 1);
      highest(r ? fars[r - 1] : down, fars[r], rows, h, w, 1);
      highest(r ? jumps[r - 1] : jump, jumps[r], rows, h, w, 1);
    }
    const auto clamped = [&](int y, int x) {
      return value[(size_t)std::min(std::max(y, 0), h - 1) * w + std::min(std::max(x, 0), w - 1)];
    };
    for (int y = top; y < bottom; y++)
      for (int x = left; x < right; x++) {
        const size_t i = at(y, x), k = (size_t)y * w + x;
        const float s = step(i), least = std::max(0.6f * (nears[RINGS - 1][k] + fars[RINGS - 1][k]), s);
        int ring = RINGS + 1;
        float near = nears[RINGS - 1][k], far = fars[RINGS - 1][k];
        for (int r = RINGS - 1; r >= 0; r--)
          if (const float gap = nears[r][k] + fars[r][k]; gap > least && jumps[r][k] > ABRUPT * gap) {
            ring = r + 1;
            near = nears[r][k];
            far = fars[r][k];
          }
        if (ramp[k]) {
          near = up[k];
          far = down[k];
        }
        far = -far;
        near_[i] = near;
        far_[i] = far;
        ramp_[i] = ramp[k];
        witness_[i] = ok[k] && !ramp[k] ? SURE[ring] : 0.0f;
        edge_[i] = (ramp[k] || ring <= RINGS) && near - far > s && ok[k];
        const float gap = std::max(near - far, 1e-12f), level = (value[k] - far) / gap;
        if (ramp[k] && std::fabs(level - 0.5f) < 0.12f) {
          const float *x0 = across + (size_t)y * wide + x, *y0 = along + (size_t)y * wide + x;
          const float mx = x0[0] * x0[1] > 0 ? 0.5f * (x0[0] + x0[1]) : 0.0f, my = y0[0] * y0[wide] > 0 ? 0.5f * (y0[0] + y0[wide]) : 0.0f;
          steepness += std::sqrt(mx * mx + my * my) / gap;
          middles++;
        }
        if (!edge_[i]) continue;
        float beside = 0, below = 0;  // differences of means of 5 x 5, two pixels to each side
        for (int d = -2; d <= 2; d++)
          for (int e = 0; e <= 4; e++) {
            beside += clamped(y + d, x + e) - clamped(y + d, x - e);
            below += clamped(y + e, x + d) - clamped(y - e, x + d);
          }
        const int direction = std::fabs(beside) > std::fabs(below) ? beside > 0 : 2 + (below > 0);
        const int place = ramp[k] ? 2 * RINGS + std::min(std::max((int)(level * LEVELS), 0), LEVELS - 1)
                                  : (level > 0.5f) * RINGS + std::min(ring, RINGS) - 1;
        kind_[i] = (uint8_t)(place * 4 + direction);
      }
    return true;
  }

  // Which of two surfaces pixels show, by their colour.
  std::vector<Judgement> judge(const std::vector<int> &pixels) const {
    std::vector<Judgement> judged(pixels.size());
    float falloff[WINDOW];
    for (int v = -REACH; v <= REACH; v++)
      for (int u = -REACH; u <= REACH; u++) falloff[(v + REACH) * SIDE + u + REACH] = std::exp(-(float)(v * v + u * u) / 12.5f);
    falloff[WINDOW / 2] = 0.0f;  // none is its own witness
    const int chunk = 512;
    parallel(ceil_div((int)pixels.size(), chunk), [&](int part) {
      std::vector<float> colours(2 * ROOM * channels_), means(2 * channels_);
      for (size_t k = (size_t)part * chunk; k < std::min(pixels.size(), (size_t)(part + 1) * chunk); k++)
        judged[k] = judge_one(pixels[k], falloff, colours.data(), means.data());
    });
    return judged;
  }

  Judgement judge_one(int i, const float *falloff, float *colours, float *means) const {
    const int y = i / width_, x = i % width_, C = channels_;
    const float near = near_[i], far = far_[i], per_gap = 1.0f / std::max(near - far, 1e-12f);
    int counts[2] = {0, 0};
    float weights[2][ROOM], values[2][ROOM], alike[2][ROOM], sums[2] = {0, 0};
    for (int v = -REACH; v <= REACH; v++) {
      const size_t row = (size_t)std::min(std::max(y + v, 0), height_ - 1) * width_;
      const float *fall = falloff + (v + REACH) * SIDE + REACH;
      for (int u = -REACH; u <= REACH; u++) {
        const size_t q = row + std::min(std::max(x + u, 0), width_ - 1);
        const float level = (given_[q] - far) * per_gap, weight = fall[u] * witness_[q];
        const int side = level > 0.75f && level < 1.25f ? 0 : level < 0.25f && level > -0.25f ? 1 : 2;
        if (side == 2 || !(weight > 0)) continue;
        const int n = counts[side]++;
        weights[side][n] = weight;
        values[side][n] = given_[q];
        for (int c = 0; c < C; c++) colours[(side * C + c) * ROOM + n] = colour_[q * C + c];
        sums[side] += weight;
      }
    }
    const bool known = sums[0] > 1e-3f && sums[1] > 1e-3f;
    if (!known) return {0.0f, 1.0f, near, far};  // the neighbours tell
    for (int side = 0; side < 2; side++)
      for (int &n = counts[side]; n % LANES; n++) {  // witnesses of no weight, up to whole vectors
        weights[side][n] = values[side][n] = 0.0f;
        for (int c = 0; c < C; c++) colours[(side * C + c) * ROOM + n] = 0.0f;
      }
    float spread = 0, contrast = 0, noise = 0, apart[2] = {0, 0};
    for (int c = 0; c < C; c++) {
      const float own = colour_[(size_t)i * C + c];
      for (int side = 0; side < 2; side++) {
        const float *colour = colours + (side * C + c) * ROOM, *weight = weights[side];
        vec weighted{}, square{};
        for (int n = 0; n < counts[side]; n += LANES) weighted += load<vec>(weight + n) * load<vec>(colour + n);
        const float mean = sum(weighted) / (sums[side] + 1e-9f);
        for (int n = 0; n < counts[side]; n += LANES) {
          const vec stray = load<vec>(colour + n) - mean;
          square += load<vec>(weight + n) * stray * stray;
        }
        spread += 0.5f * sum(square) / (sums[side] + 1e-9f);
        means[side * C + c] = mean;
        apart[side] += (own - mean) * (own - mean);
      }
      const float both = means[c] + means[C + c], between = means[c] - means[C + c];
      noise += both * both;
      contrast += between * between;
    }
    spread += 2.25e-4f * noise + 1e-12f;
    const float per_spread = 1.0f / (0.3f * spread);
    float likelihood[2], surface[2];
    for (int side = 0; side < 2; side++) {
      const int count = counts[side];
      float *like = alike[side];
      std::fill(like, like + count, 0.0f);
      for (int c = 0; c < C; c++) {
        const float own = colour_[(size_t)i * C + c], *colour = colours + (side * C + c) * ROOM;
        for (int n = 0; n < count; n++) like[n] += (colour[n] - own) * (colour[n] - own);
      }
      vec total{}, share{}, value{};
      for (int n = 0; n < count; n += LANES) {
        const vec t = 1.0f + load<vec>(like + n) * per_spread, l = 1.0f / (t * t);
        const vec weight = load<vec>(weights[side] + n), part = weight * (l + 1e-3f);
        total += weight * l;
        share += part;
        value += part * (load<vec>(values[side] + n) - near);
      }
      const float t = 1.0f + apart[side] * per_spread;
      likelihood[side] = sum(total) / (sums[side] + 1e-9f) + 0.02f / (t * t) + 1e-9f;
      surface[side] = near + sum(value) / std::max(sum(share), 1e-12f);
    }
    const float tells = std::max(contrast / (contrast + 0.5f * spread) - 0.1f, 0.0f) / 0.9f;
    return {clamp(std::log(likelihood[0] / likelihood[1]), -8.0f, 8.0f), tells, surface[0], surface[1]};
  }

  // Neighbours of like colour decide together.
  void decide(const std::vector<int> &pixels, std::vector<Judgement> &judged, std::vector<float> &evidence) {
    const float unknown = std::nanf("");
    Buffer<float> said(area_);
    parallel(height_, [&](int y) { std::fill(said.data() + (size_t)y * width_, said.data() + (size_t)(y + 1) * width_, unknown); });
    for (size_t k = 0; k < pixels.size(); k++) said[pixels[k]] = judged[k].score;
    evidence.assign(pixels.size(), 0.0f);
    const int chunk = 4096, C = channels_;
    parallel(ceil_div((int)pixels.size(), chunk), [&](int part) {
      for (size_t k = (size_t)part * chunk; k < std::min(pixels.size(), (size_t)(part + 1) * chunk); k++) {
        const int i = pixels[k], y = i / width_, x = i % width_;
        const float *own = colour_.data() + (size_t)i * C;
        float light = 0, total = 0, sum = 0, strongest = 0;
        for (int c = 0; c < C; c++) light += own[c] * own[c];
        for (int v = -1; v <= 1; v++)
          for (int u = -1; u <= 1; u++) {
            const size_t q = (size_t)std::min(std::max(y + v, 0), height_ - 1) * width_ + std::min(std::max(x + u, 0), width_ - 1);
            if (std::isnan(said[q])) continue;
            float apart = 0;
            for (int c = 0; c < C; c++) apart += (colour_[q * C + c] - own[c]) * (colour_[q * C + c] - own[c]);
            const float alike = 1.0f / (1.0f + apart / (0.0225f * light + 1e-12f));
            total += alike;
            sum += alike * said[q];
            strongest = std::max(strongest, std::fabs(said[q]));
          }
        judged[k].score = clamp(SHARPNESS * judged[k].tells * sum / std::max(total, 1e-12f), -6.0f, 6.0f);
        evidence[k] = clamp01(2.0f * judged[k].tells * strongest - 1.0f);
      }
    });
    // from the ends of a wide ramp only one of the surfaces is in sight
    parallel(height_, [&](int y) { std::fill(said.data() + (size_t)y * width_, said.data() + (size_t)(y + 1) * width_, 0.0f); });
    for (size_t k = 0; k < pixels.size(); k++) said[pixels[k]] = evidence[k];
    parallel(ceil_div((int)pixels.size(), chunk), [&](int part) {
      for (size_t k = (size_t)part * chunk; k < std::min(pixels.size(), (size_t)(part + 1) * chunk); k++) {
        const int i = pixels[k], y = i / width_, x = i % width_;
        for (int v = std::max(0, y - 3); v <= std::min(height_ - 1, y + 3); v++)
          for (int u = std::max(0, x - 3); u <= std::min(width_ - 1, x + 3); u++)
            evidence[k] = std::max(evidence[k], said[(size_t)v * width_ + u]);
      }
    });
  }

  // Whether what colours say agrees with the map where that is hardly in doubt.
  bool is_related(const std::vector<int> &pixels, const std::vector<Judgement> &judged) const {
    double total = 0, agreed = 0;
    for (size_t k = 0; k < pixels.size(); k++) {
      const size_t i = pixels[k];
      const float score = judged[k].score, level = (given_[i] - far_[i]) / std::max(near_[i] - far_[i], 1e-12f);
      if (ramp_[i] ? std::fabs(level - 0.5f) <= 0.3f : kind_[i] / 4 % RINGS != RINGS - 1) continue;
      const float weight = std::min(0.5f * std::fabs(score), 1.0f);
      total += weight;
      if ((score > 0) == (level > 0.5f)) agreed += weight;
    }
    return (agreed + 0.5f * PRIOR_COUNT) / (total + PRIOR_COUNT) > RELATED;
  }

  // Share of pixels that show the near surface, by kind.
  void calibrate(const std::vector<int> &pixels, const std::vector<Judgement> &judged) {
    std::vector<float> assumed(PLACES), start(PLACES);
    for (int p = 0; p < PLACES; p++) {
      assumed[p] = p < RINGS ? TRUSTED : p < 2 * RINGS ? 1.0f - TRUSTED : (p - 2 * RINGS + 0.5f) / LEVELS;
      start[p] = p < 2 * RINGS ? 0.5f : assumed[p];
    }
    const std::vector<float> together = fit(pixels, judged, 4, start, assumed);
    std::vector<float> each(KINDS);
    for (int k = 0; k < KINDS; k++) each[k] = together[k / 4];
    shares_ = fit(pixels, judged, 1, std::vector<float>(KINDS, 0.5f), each);
    // where the pixels beside a step are right those farther away are too
    for (int r = 1; r < RINGS; r++)
      for (int d = 0; d < 4; d++) {
        float *far = &shares_[r * 4 + d], *near = &shares_[(RINGS + r) * 4 + d];
        *far = std::min(*far, far[-4]);
        *near = std::max(*near, near[-4]);
      }
  }

  std::vector<float> fit(const std::vector<int> &pixels, const std::vector<Judgement> &judged, int together, std::vector<float> share,
                         const std::vector<float> &assumed) const {
    const size_t count = share.size();
    std::vector<double> total(count, 0.0), found(count);
    for (size_t k = 0; k < pixels.size(); k++) total[kind_[pixels[k]] / together] += std::min(0.5f * std::fabs(judged[k].score), 1.0f);
    for (int round = 0; round < ROUNDS; round++) {
      std::fill(found.begin(), found.end(), 0.0);
      std::vector<float> odds(count);
      for (size_t g = 0; g < count; g++) odds[g] = (1.0f - share[g]) / share[g];
      for (size_t k = 0; k < pixels.size(); k++) {
        const float score = judged[k].score, weight = std::min(0.5f * std::fabs(score), 1.0f);
        const int group = kind_[pixels[k]] / together;
        if (weight > 0) found[group] += weight / (1.0f + odds[group] * std::exp(-score));
      }
      for (size_t g = 0; g < count; g++)
        share[g] = clamp((float)((found[g] + PRIOR_COUNT * assumed[g]) / (total[g] + PRIOR_COUNT)), 0.005f, 0.995f);
    }
    return share;
  }

  float blur() const {
    const double width = middles_ / std::max(std::sqrt(2 * 3.14159265358979323846) * steepness_, 1e-12);
    return (float)std::sqrt(std::min(std::max(width * width - 0.75, 0.25), 9.0));
  }

  struct Line {
    float least, difference, fit;
  };

  // Nearness around a pixel as a + b cover.
  Line regress(const float *cover, int i) const {
    const int y = i / width_, x = i % width_;
    double weights = 0, mx = 0, my = 0, xx = 0, yy = 0, xy = 0;
    const float own = given_[i];
    for (int v = -REACH; v <= REACH; v++)
      for (int u = -REACH; u <= REACH; u++) {
        const size_t q = (size_t)std::min(std::max(y + v, 0), height_ - 1) * width_ + std::min(std::max(x + u, 0), width_ - 1);
        const double weight = std::exp(-(v * v + u * u) / 18.0f), cx = cover[q], cy = given_[q] - own;
        weights += weight;
        mx += weight * cx;
        my += weight * cy;
        xx += weight * cx * cx;
        yy += weight * cy * cy;
        xy += weight * cx * cy;
      }
    mx /= weights;
    my /= weights;
    xx = xx / weights - mx * mx;
    yy = yy / weights - my * my;
    xy = std::max(xy / weights - mx * my, 0.0);
    const double b = xy / std::max(xx, 1e-9), explained = xy * xy / std::max(xx * yy, 1e-12);
    return {(float)(my - b * mx + own), (float)b, xx > 0.004 ? clamp01((float)((explained - 0.5) / 0.3)) : 0.0f};
  }

  void unmix(const std::vector<int> &pixels, const std::vector<uint8_t> &shows, float sigma, std::vector<Judgement> &judged) const {
    Plane label(area_), blurred(area_), a(area_), b(area_), rows(area_);
    whole(given_.data(), a.data(), rows.data(), 6, 1.0f);
    whole(given_.data(), b.data(), rows.data(), 6, -1.0f);  // the lowest, negative
    for (size_t i = 0; i < area_; i++) label[i] = edge_[i] ? is_near(i) : 2.0f * given_[i] > a[i] - b[i];
    for (size_t k = 0; k < pixels.size(); k++) label[pixels[k]] = shows[k];
    gaussian(label.data(), blurred.data(), rows.data(), sigma);
    std::vector<uint8_t> thin[2];
    for (int side = 0; side < 2; side++) {
      thin[side].resize(pixels.size());
      for (size_t i = 0; i < area_; i++) a[i] = !edge_[i] || (label[i] > 0) == (side == 0) ? -1.0f : 0.0f;
      whole(a.data(), b.data(), rows.data(), 2, 1.0f);
      for (size_t i = 0; i < area_; i++) b[i] = -b[i];
      whole(b.data(), a.data(), rows.data(), 2, 1.0f);
      for (size_t k = 0; k < pixels.size(); k++) thin[side][k] = (label[pixels[k]] > 0) == (side == 0) && !(a[pixels[k]] > 0);
    }
    whole(given_.data(), a.data(), rows.data(), 12, -1.0f);
    const int chunk = 512;
    parallel(ceil_div((int)pixels.size(), chunk), [&](int part) {
      for (size_t k = (size_t)part * chunk; k < std::min(pixels.size(), (size_t)(part + 1) * chunk); k++) {
        if (!thin[0][k] && !thin[1][k]) continue;
        const Line line = regress(blurred.data(), pixels[k]);
        float &near = judged[k].near, &far = judged[k].far;
        const float gap = near - far;
        if (thin[0][k])
          near += line.fit * std::max(std::min(line.least + line.difference, far + MOST * gap) - near, 0.0f);
        else
          far += line.fit * std::min(std::max(line.least, std::max(near - MOST * gap, -a[pixels[k]])) - far, 0.0f);
      }
    });
  }

  // Lamps of a few pixels, whose nearness a soft map spreads around them.
  void lift_lamps(float sigma) {
    Plane brightest(area_), usual(area_), around(area_), a(area_), b(area_), rows(area_);
    for (size_t i = 0; i < area_; i++) {
      float most = 0;
      for (int c = 0; c < channels_; c++) most = std::max(most, colour_[i * channels_ + c]);
      a[i] = most;
      brightest[i] = most * most;
    }
    mean(a.data(), usual.data(), rows.data(), height_, width_, REACH + 2);
    whole(brightest.data(), around.data(), rows.data(), 2, 1.0f);
    Plane cover(area_), blurred(area_);
    for (size_t i = 0; i < area_; i++) {
      usual[i] *= usual[i];
      cover[i] = brightest[i] > 2.0f * usual[i] ? brightest[i] / std::max(around[i], 1e-30f) : 0.0f;
    }
    gaussian(cover.data(), blurred.data(), rows.data(), sigma);
    whole(given_.data(), a.data(), rows.data(), REACH, 1.0f);
    whole(given_.data(), b.data(), rows.data(), REACH, -1.0f);
    parallel(height_, [&](int y) {
      for (int x = 0; x < width_; x++) {
        const size_t i = (size_t)y * width_ + x;
        if (!(std::fabs(map_.nearness[i]) <= LARGEST) || brightest[i] <= 4.0f * usual[i] || brightest[i] <= 0.1f * around[i] || a[i] + b[i] <= 0.5f * step(i)) continue;
        const Line line = regress(blurred.data(), (int)i);
        map_.out[i] += line.fit * std::max(line.least + std::max(line.difference, 0.0f) - map_.out[i], 0.0f);
      }
    });
  }

  // `highest` of a whole frame, of its values times a sign, by rows.
  void whole(const float *in, float *out, float *rows, int reach, float sign) const {
    parallel(height_, [&](int y) {
      const float *from = in + (size_t)y * width_;
      int length = width_ + 2 * reach;
      Buffer<float> row(length);
      std::fill(row.data(), row.data() + reach, -NONE);
      for (int x = 0; x < width_; x++) row[reach + x] = sign * from[x];
      std::fill(row.data() + reach + width_, row.data() + length, -NONE);
      widen(reach, [&](int by) { raise(row.data(), row.data() + by, length -= by); });
      memcpy(rows + (size_t)y * width_, row.data(), width_ * sizeof(float));
    });
    parallel(height_, [&](int y) {
      float *to = out + (size_t)y * width_;
      const int first = std::max(0, y - reach), last = std::min(height_ - 1, y + reach);
      memcpy(to, rows + (size_t)first * width_, width_ * sizeof(float));
      for (int v = first + 1; v <= last; v++) raise(to, rows + (size_t)v * width_, width_);
    });
  }

  void gaussian(const float *in, float *out, float *rows, float sigma) const {
    float kernel[2 * BLUR_REACH + 1], sum = 0;
    for (int d = -BLUR_REACH; d <= BLUR_REACH; d++) sum += kernel[d + BLUR_REACH] = std::exp(-(float)(d * d) / (2.0f * sigma * sigma));
    for (float &k : kernel) k /= sum;
    parallel(height_, [&](int y) {
      const float *from = in + (size_t)y * width_;
      Buffer<float> row(width_ + 2 * BLUR_REACH);
      std::fill(row.data(), row.data() + BLUR_REACH, from[0]);
      memcpy(row.data() + BLUR_REACH, from, width_ * sizeof(float));
      std::fill(row.data() + BLUR_REACH + width_, row.data() + width_ + 2 * BLUR_REACH, from[width_ - 1]);
      float *to = rows + (size_t)y * width_;
      std::fill(to, to + width_, 0.0f);
      for (int d = 0; d <= 2 * BLUR_REACH; d++)
        for (int x = 0; x < width_; x++) to[x] += kernel[d] * row[x + d];
    });
    parallel(height_, [&](int y) {
      float *to = out + (size_t)y * width_;
      std::fill(to, to + width_, 0.0f);
      for (int d = -BLUR_REACH; d <= BLUR_REACH; d++) {
        const float *from = rows + (size_t)std::min(std::max(y + d, 0), height_ - 1) * width_;
        for (int x = 0; x < width_; x++) to[x] += kernel[d + BLUR_REACH] * from[x];
      }
    });
  }

  const torchdof_map &map_;
  const int height_, width_, channels_;
  const size_t area_;
  Buffer<float> given_, colour_, near_, far_, witness_;
  Buffer<uint8_t> edge_, ramp_, kind_;
  std::vector<float> shares_;
  double steepness_ = 0;
  int64_t middles_ = 0;
};

}  // namespace

void repair_edges(const torchdof_map &map) { Repair(map).run(); }

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
