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
constexpr int SAMPLED = 1 << 17, SAMPLE_BLOCK = 16, BLUR_REACH = 9;
constexpr int AREA = 64, HALO = 21;  // what a pixel shows depends on what is so far around it
constexpr float NONE = 1e30f;
constexpr int SIDE = 2 * REACH + 1, WINDOW = SIDE * SIDE;

// A part of the frame and its surroundings, as far as the frame goes.
struct Part {
  int y0, x0, height, width;
};

using Plane = std::vector<float>;

// The largest of a square around each value.
void highest(const float *in, float *out, float *rows, int height, int width, int reach) {
  for (int y = 0; y < height; y++) {
    const float *from = in + (size_t)y * width;
    float *to = rows + (size_t)y * width;
    memcpy(to, from, width * sizeof(float));
    for (int d = 1; d <= reach; d++) {
      for (int x = 0; x < width - d; x++) to[x] = to[x] < from[x + d] ? from[x + d] : to[x];
      for (int x = d; x < width; x++) to[x] = to[x] < from[x - d] ? from[x - d] : to[x];
    }
  }
  for (int y = 0; y < height; y++) {
    float *to = out + (size_t)y * width;
    const int first = std::max(0, y - reach), last = std::min(height - 1, y + reach);
    memcpy(to, rows + (size_t)first * width, width * sizeof(float));
    for (int v = first + 1; v <= last; v++) {
      const float *from = rows + (size_t)v * width;
      for (int x = 0; x < width; x++) to[x] = to[x] < from[x] ? from[x] : to[x];
    }
  }
}

// The mean of a square around each value, which goes on beyond the border as it is at it.
void mean(const float *in, float *out, float *rows, int height, int width, int reach) {
  const float share = 1.0f / (2 * reach + 1);
  for (int y = 0; y < height; y++) {
    const float *from = in + (size_t)y * width;
    float *to = rows + (size_t)y * width;
    for (int x = 0; x < width; x++) {
      float sum = 0;
      if (x >= reach && x < width - reach)
        for (int d = -reach; d <= reach; d++) sum += from[x + d];
      else
        for (int d = -reach; d <= reach; d++) sum += from[std::min(std::max(x + d, 0), width - 1)];
      to[x] = sum * share;
    }
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

float logit(float p) { return std::log(p / (1.0f - p)); }

struct Judgement {
  float score, tells, near, far;
};

class Repair {
 public:
  explicit Repair(const torchdof_map &map)
      : map_(map), height_(map.height), width_(map.width), channels_(map.channels), area_((size_t)map.height * map.width) {}

  void run() {
    take();
    find();
    const std::vector<int> sampled = list([&](int y, int x, size_t i) {
      const int64_t every = ((int64_t)area_ + SAMPLED - 1) / SAMPLED;
      return edge_[i] && (y / SAMPLE_BLOCK + 3 * (x / SAMPLE_BLOCK)) % every == 0;
    });
    std::vector<Judgement> judged = judge(sampled);
    std::vector<float> evidence;
    decide(sampled, judged, evidence);
    calibrate(sampled, judged);
    const bool related = !map_.automatic || is_related(sampled, judged);
    const bool is_soft = related && (double)ramps_ > SOFT * (double)std::max<int64_t>(1, edges_);
    const std::vector<int> pixels = list([&](int, int, size_t i) {
      if (!map_.automatic) return true;
      if (!related) return false;
      const float prior = shares_[kind_[i]];
      return ramp_[i] ? is_soft : (is_near(i) ? 1.0f - prior : prior) > EXACT;
    });
    parallel(height_, [&](int y) {
      memcpy(map_.out + (size_t)y * width_, map_.nearness + (size_t)y * width_, width_ * sizeof(float));
    });
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

  template <typename Chosen>
  std::vector<int> list(const Chosen &chosen) const {
    std::vector<int> found;
    for (int y = 0; y < height_; y++)
      for (int x = 0; x < width_; x++) {
        const size_t i = (size_t)y * width_ + x;
        if (edge_[i] && chosen(y, x, i)) found.push_back((int)i);
      }
    return found;
  }

  void take() {
    given_ = Buffer<float>(area_);
    valid_ = Buffer<uint8_t>(area_);
    colour_ = Buffer<float>(area_ * channels_);
    near_ = Buffer<float>(area_);
    far_ = Buffer<float>(area_);
    witness_ = Buffer<float>(area_);
    edge_ = Buffer<uint8_t>(area_);
    ramp_ = Buffer<uint8_t>(area_);
    kind_ = Buffer<uint8_t>(area_);
    parallel(height_, [&](int y) {
      for (size_t i = (size_t)y * width_; i < (size_t)(y + 1) * width_; i++) {
        const float v = map_.nearness[i];
        valid_[i] = std::isfinite(v);
        given_[i] = valid_[i] ? v : 0.0f;
        edge_[i] = ramp_[i] = kind_[i] = 0;
        witness_[i] = valid_[i] ? 1.0f : 0.0f;
        near_[i] = far_[i] = given_[i];
      }
      for (int c = 0; c < channels_; c++) {
        const float *light = map_.light + c * area_ + (size_t)y * width_;
        float *to = colour_.data() + (size_t)y * width_ * channels_ + c;
        for (int x = 0; x < width_; x++) to[(size_t)x * channels_] = std::isfinite(light[x]) ? std::sqrt(std::max(light[x], 0.0f)) : 0.0f;
      }
    });
  }

  // Ramps and steps, and the two surfaces that meet there.
  void find() {
    const int rows = ceil_div(height_, AREA), columns = ceil_div(width_, AREA), parts = rows * columns;
    std::vector<double> steepness(parts, 0.0);
    std::vector<int64_t> middles(parts, 0), ramps(parts, 0), edges(parts, 0);
    parallel(parts, [&](int p) {
      const int top = p / columns * AREA, left = p % columns * AREA;
      const Part part = {std::max(0, top - HALO), std::max(0, left - HALO),
                         std::min(height_, top + AREA + HALO) - std::max(0, top - HALO),
                         std::min(width_, left + AREA + HALO) - std::max(0, left - HALO)};
      find_in(part, top, left, steepness[p], middles[p], ramps[p], edges[p]);
    });
    for (int p = 0; p < parts; p++) {
      steepness_ += steepness[p];
      middles_ += middles[p];
      ramps_ += ramps[p];
      edges_ += edges[p];
    }
  }

  void find_in(const Part &part, int top, int left, double &steepness, int64_t &middles, int64_t &ramps, int64_t &edges) {
    const int h = part.height, w = part.width;
    const size_t size = (size_t)h * w;
    const auto at = [&](int y, int x) { return (size_t)(part.y0 + y) * width_ + part.x0 + x; };
    float low = NONE, high = -NONE, least_step = NONE;
    for (int y = 0; y < h; y++)
      for (int x = 0; x < w; x++) {
        const size_t i = at(y, x);
        if (!valid_[i]) continue;
        low = std::min(low, given_[i]);
        high = std::max(high, given_[i]);
        least_step = std::min(least_step, step(i));
      }
    if (!(high - low > least_step)) return;
    Plane value(size), up(size), down(size), slope(size), steep(size), jump(size), a(size), b(size), rows(size);
    std::vector<uint8_t> ok(size), ramp(size);
    for (int y = 0; y < h; y++)
      for (int x = 0; x < w; x++) {
        const size_t i = at(y, x), k = (size_t)y * w + x;
        value[k] = given_[i];
        ok[k] = valid_[i];
        up[k] = ok[k] ? value[k] : -NONE;
        down[k] = ok[k] ? -value[k] : -NONE;
      }
    for (int y = 0; y < h; y++)
      for (int x = 0; x < w; x++) {
        const size_t k = (size_t)y * w + x;
        const auto change = [&](bool inside, size_t from, size_t to) {
          return inside && ok[from] && ok[to] ? value[to] - value[from] : 0.0f;
        };
        const float x0 = change(x > 0, k - 1, k), x1 = change(x < w - 1, k, k + 1);
        const float y0 = change(y > 0, k - w, k), y1 = change(y < h - 1, k, k + w);
        const bool across = x0 * x1 > 0, along = y0 * y1 > 0;
        const float sx = across ? std::min(std::fabs(x0), std::fabs(x1)) : 0.0f;
        const float sy = along ? std::min(std::fabs(y0), std::fabs(y1)) : 0.0f;
        slope[k] = std::max(sx, sy);
        jump[k] = std::max(std::max(std::fabs(x0), std::fabs(x1)) - sx, std::max(std::fabs(y0), std::fabs(y1)) - sy);
        const float mx = across ? 0.5f * (x0 + x1) : 0.0f, my = along ? 0.5f * (y0 + y1) : 0.0f;
        steep[k] = std::sqrt(mx * mx + my * my);
      }
    highest(up.data(), a.data(), rows.data(), h, w, REACH);
    highest(down.data(), b.data(), rows.data(), h, w, REACH);
    bool any = false;
    for (int y = 0; y < h; y++)
      for (int x = 0; x < w; x++) {
        const size_t k = (size_t)y * w + x;
        const float span = a[k] + b[k], s = step(at(y, x));
        ramp[k] = slope[k] > 0.1f * s && slope[k] > SHALLOW * span && span > s && ok[k];
        any |= ramp[k];
      }
    if (any) {  // a ramp ends, a slope goes on
      Plane flat(size);
      mean(slope.data(), flat.data(), rows.data(), h, w, 2);
      for (float &v : flat) v = -v;
      highest(flat.data(), a.data(), rows.data(), h, w, 8);
      for (size_t k = 0; k < size; k++) ramp[k] &= -a[k] < 0.3f * slope[k];
      // the surfaces at both ends of a ramp
      Plane up_end = up, down_end = down;
      for (int round = 0; round < RAMP_REACH; round++) {
        highest(up_end.data(), a.data(), rows.data(), h, w, 1);
        highest(down_end.data(), b.data(), rows.data(), h, w, 1);
        for (size_t k = 0; k < size; k++)
          if (ramp[k]) {
            up_end[k] = a[k];
            down_end[k] = b[k];
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
    }
    // those at both sides of a step
    Plane nears[RINGS], fars[RINGS], jumps[RINGS];
    for (int r = 0; r < RINGS; r++) {
      nears[r].resize(size);
      fars[r].resize(size);
      highest(up.data(), nears[r].data(), rows.data(), h, w, r + 1);
      jumps[r].resize(size);
      highest(down.data(), fars[r].data(), rows.data(), h, w, r + 1);
      highest(jump.data(), jumps[r].data(), rows.data(), h, w, r + 1);
    }
    const auto clamped = [&](int y, int x) {
      return value[(size_t)std::min(std::max(y, 0), h - 1) * w + std::min(std::max(x, 0), w - 1)];
    };
    for (int y = top - part.y0; y < std::min(h, top - part.y0 + AREA); y++)
      for (int x = left - part.x0; x < std::min(w, left - part.x0 + AREA); x++) {
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
          steepness += steep[k] / gap;
          middles++;
        }
        ramps += ramp[k];
        edges += edge_[i];
        if (!edge_[i]) continue;
        float right = 0, below = 0;  // differences of means of 5 x 5, two pixels to each side
        for (int d = -2; d <= 2; d++)
          for (int e = 0; e <= 4; e++) {
            right += clamped(y + d, x + e) - clamped(y + d, x - e);
            below += clamped(y + e, x + d) - clamped(y - e, x + d);
          }
        const int direction = std::fabs(right) > std::fabs(below) ? right > 0 : 2 + (below > 0);
        const int place = ramp[k] ? 2 * RINGS + std::min(std::max((int)(level * LEVELS), 0), LEVELS - 1)
                                  : (level > 0.5f) * RINGS + std::min(ring, RINGS) - 1;
        kind_[i] = (uint8_t)(place * 4 + direction);
      }
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
      std::vector<float> colours(2 * WINDOW * channels_), means(2 * channels_);
      for (size_t k = (size_t)part * chunk; k < std::min(pixels.size(), (size_t)(part + 1) * chunk); k++)
        judged[k] = judge_one(pixels[k], falloff, colours.data(), means.data());
    });
    return judged;
  }

  Judgement judge_one(int i, const float *falloff, float *colours, float *means) const {
    const int y = i / width_, x = i % width_, C = channels_;
    const float near = near_[i], far = far_[i], per_gap = 1.0f / std::max(near - far, 1e-12f);
    int counts[2] = {0, 0};
    float weights[2][WINDOW], values[2][WINDOW], alike[2][WINDOW], sums[2] = {0, 0};
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
        for (int c = 0; c < C; c++) colours[(side * C + c) * WINDOW + n] = colour_[q * C + c];
        sums[side] += weight;
      }
    }
    const bool known = sums[0] > 1e-3f && sums[1] > 1e-3f;
    if (!known) return {0.0f, 1.0f, near, far};  // the neighbours tell
    float spread = 0, contrast = 0, noise = 0, apart[2] = {0, 0};
    for (int c = 0; c < C; c++) {
      const float own = colour_[(size_t)i * C + c];
      for (int side = 0; side < 2; side++) {
        const float *colour = colours + (side * C + c) * WINDOW, *weight = weights[side];
        float mean = 0, square = 0;
        for (int n = 0; n < counts[side]; n++) mean += weight[n] * colour[n];
        mean /= sums[side] + 1e-9f;
        for (int n = 0; n < counts[side]; n++) square += weight[n] * (colour[n] - mean) * (colour[n] - mean);
        spread += 0.5f * square / (sums[side] + 1e-9f);
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
        const float own = colour_[(size_t)i * C + c], *colour = colours + (side * C + c) * WINDOW;
        for (int n = 0; n < count; n++) like[n] += (colour[n] - own) * (colour[n] - own);
      }
      float total = 0, share = 0, value = 0;
      for (int n = 0; n < count; n++) {
        const float t = 1.0f + like[n] * per_spread, l = 1.0f / (t * t), part = weights[side][n] * (l + 1e-3f);
        total += weights[side][n] * l;
        share += part;
        value += part * (values[side][n] - near);
      }
      const float t = 1.0f + apart[side] * per_spread;
      likelihood[side] = total / (sums[side] + 1e-9f) + 0.02f / (t * t) + 1e-9f;
      surface[side] = near + value / std::max(share, 1e-12f);
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
        if (!valid_[i] || brightest[i] <= 4.0f * usual[i] || brightest[i] <= 0.1f * around[i] || a[i] + b[i] <= 0.5f * step(i)) continue;
        const Line line = regress(blurred.data(), (int)i);
        map_.out[i] += line.fit * std::max(line.least + std::max(line.difference, 0.0f) - map_.out[i], 0.0f);
      }
    });
  }

  // `highest` of a whole frame, of its values times a sign, in strips.
  void whole(const float *in, float *out, float *rows, int reach, float sign) const {
    parallel(height_, [&](int y) {
      const float *from = in + (size_t)y * width_;
      float *to = rows + (size_t)y * width_;
      for (int x = 0; x < width_; x++) {
        float most = sign * from[x];
        for (int u = std::max(0, x - reach); u <= std::min(width_ - 1, x + reach); u++) most = std::max(most, sign * from[u]);
        to[x] = most;
      }
    });
    parallel(height_, [&](int y) {
      float *to = out + (size_t)y * width_;
      const int first = std::max(0, y - reach), last = std::min(height_ - 1, y + reach);
      memcpy(to, rows + (size_t)first * width_, width_ * sizeof(float));
      for (int v = first + 1; v <= last; v++) {
        const float *from = rows + (size_t)v * width_;
        for (int x = 0; x < width_; x++) to[x] = to[x] < from[x] ? from[x] : to[x];
      }
    });
  }

  void gaussian(const float *in, float *out, float *rows, float sigma) const {
    float kernel[2 * BLUR_REACH + 1], sum = 0;
    for (int d = -BLUR_REACH; d <= BLUR_REACH; d++) sum += kernel[d + BLUR_REACH] = std::exp(-(float)(d * d) / (2.0f * sigma * sigma));
    for (float &k : kernel) k /= sum;
    parallel(height_, [&](int y) {
      const float *from = in + (size_t)y * width_;
      for (int x = 0; x < width_; x++) {
        float total = 0;
        for (int d = -BLUR_REACH; d <= BLUR_REACH; d++) total += kernel[d + BLUR_REACH] * from[std::min(std::max(x + d, 0), width_ - 1)];
        rows[(size_t)y * width_ + x] = total;
      }
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
  Buffer<uint8_t> valid_, edge_, ramp_, kind_;
  std::vector<float> shares_;
  double steepness_ = 0;
  int64_t middles_ = 0, ramps_ = 0, edges_ = 0;
};

}  // namespace

void repair_edges(const torchdof_map &map) { Repair(map).run(); }

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
