// Strands thinner than a pixel: pixels between the dashes that depth shows of them are split between the strand and
// what is behind. The formulas are told in render/strands.py.
#include "matting.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

constexpr int REACH = 3;            // pixels around one that tell of a strand through it
constexpr float WIDTH = 0.2f;       // variance of a strand's pixels across it, px^2
constexpr float NARROW = 0.5f;      // variance of these across their line up to which it is one strand's, px^2
constexpr float LEVEL = 1.0f;       // px^2 by which what is behind a strand is taken for level rather than inclined
constexpr float SEEN = 3.0f;        // part of 1 / pixels that must show a strand, and what is behind, for these to be sure
constexpr float LEAST_COVERED = 0.05f;  // part of a pixel from which on a strand is told from texture
constexpr float MOST_COVERED = 0.6f;  // part of a pixel that a strand beside its centre covers

constexpr int SIDE = 2 * REACH + 1;
constexpr int FULL = BLOCK + 2 * (REACH + 2);  // of coc: a strand is told by its neighbours, and what touches one by these
constexpr int MIDDLE = BLOCK + 2 * (REACH + 1);
constexpr int NEAREST = BLOCK + 2 * REACH;
constexpr int PITCH = 32;  // of all three
constexpr int PARTS = 8 / LANES;  // in which a row of pixels around one, and the next, which does not count, is looked at
static_assert(FULL + LANES <= PITCH + LANES && SIDE < 8, "whole lanes, some of them beyond what counts");

// Pixels of a row around one: how far right they are, whether they count, and how much they do in each row.
struct Around {
  vec right[PARTS], counts[PARTS], falloff[SIDE][PARTS];
  float along[SIDE];
  Around() {
    for (int i = 0; i < 8; i++) {
      const int part = i / LANES, lane = i % LANES;
      right[part][lane] = (float)(i - REACH);
      counts[part][lane] = i < SIDE;
      for (int r = 0; r < SIDE; r++) falloff[r][part][lane] = i < SIDE ? falloff_at(r - REACH, i - REACH) : 0.0f;
      if (i < SIDE) along[i] = falloff_at(0, i - REACH);
    }
  }
};

// As many pixels as there are lanes, each beside a strand, and what the pixels around them sum to: of what is behind, how many,
// their places and how much their light differs; then, of each colour, what differs, times place, and that of the strand.
struct Batch {
  enum { TOTAL, DOWN, RIGHT, DOWN_DOWN, RIGHT_RIGHT, DOWN_RIGHT, SQUARE, OF_COLOURS };
  enum { LIGHT_DOWN, LIGHT_RIGHT, STRAND, A_COLOUR };
  int count = 0;
  int y[LANES], x[LANES];
  vec coc, amount, sureness, scale;  // how many pixels show the strand; the largest light around
  std::vector<vec> around;           // [OF_COLOURS + A_COLOUR * channels, LANES]
  std::vector<vec> mean, back, front, colour;  // mean: of what is behind
};

}  // namespace

struct Strands::Maps {
  float coc[FULL * PITCH + LANES], thin[MIDDLE * PITCH + LANES], clear[NEAREST * PITCH + LANES];
  float size[NEAREST * PITCH + LANES];  // largest light of the colours, as a magnitude
  float line[4][NEAREST * BLOCK];  // sums along rows of pixels that show a strand: how many, their coc, x and x^2
  std::vector<float> light;        // [channels, NEAREST, PITCH]
  Batch batch;
};

namespace {

// A pixel outside the frame is the nearest one inside.
struct Inside {
  int y0, x0, height, width;
  int row(int i, int margin) const { return std::clamp(y0 - margin + i, 0, height - 1); }
  int column(int j, int margin) const { return std::clamp(x0 - margin + j, 0, width - 1); }
  bool all(int margin) const { return y0 >= margin && x0 >= margin && y0 + BLOCK + margin <= height && x0 + BLOCK + margin <= width; }
  // Fills a map around the block, of margin and side, that was made as if there were pixels outside.
  void repeat(float *map, int side, int margin) const {
    for (int i = 0; i < side; i++)
      for (int j = 0; j < side; j++)
        if (row(i, margin) != y0 - margin + i || column(j, margin) != x0 - margin + j)
          map[i * PITCH + j] = map[(row(i, margin) - y0 + margin) * PITCH + column(j, margin) - x0 + margin];
  }
  void copy(const float *plane, float *map, int side, int margin) const {
    for (int i = 0; i < side; i++) {
      const float *from = plane + (size_t)row(i, margin) * width;
      if (x0 >= margin && x0 + BLOCK + margin <= width)
        memcpy(map + i * PITCH, from + x0 - margin, side * sizeof(float));
      else
        for (int j = 0; j < side; j++) map[i * PITCH + j] = from[column(j, margin)];
    }
  }
};

// How surely pixels around a block are a strand's, and what touches none; false if no strand is around.
bool find_strands(const Job &job, const Inside &frame, Strands::Maps &w) {
  const float *valid = job.surfaces.valid;
  frame.copy(job.surfaces.coc, w.coc, FULL, REACH + 2);
  const float *farthest = w.coc;
  float known[FULL * PITCH + LANES] = {}, counted[FULL * PITCH + LANES] = {};
  if (valid) {
    frame.copy(valid, counted, FULL, REACH + 2);
    for (int i = 0; i < FULL * PITCH; i++) known[i] = counted[i] > 0 ? w.coc[i] : -NEVER;
    farthest = known;
  }
  float blocks[FULL * PITCH + LANES] = {};  // of 2 x 2 pixels, the farthest
  for (int i = 0; i < FULL - 1; i++)
    for (int j = 0; j < FULL - 1; j += LANES) {
      const float *c = farthest + i * PITCH + j;
      store(blocks + i * PITCH + j, most(most(load<vec>(c), load<vec>(c + 1)), most(load<vec>(c + PITCH), load<vec>(c + PITCH + 1))));
    }
  vec any = {};
  for (int i = 0; i < MIDDLE; i++)
    for (int j = 0; j < MIDDLE; j += LANES) {
      const float *b = blocks + i * PITCH + j;
      const vec opened = least(least(load<vec>(b), load<vec>(b + 1)), least(load<vec>(b + PITCH), load<vec>(b + PITCH + 1)));
      vec thin = clamp01((opened - load<vec>(w.coc + (i + 1) * PITCH + j + 1)) / EDGE_PX - 1.0f);
      if (valid) thin *= load<vec>(counted + (i + 1) * PITCH + j + 1);
      store(w.thin + i * PITCH + j, thin);
      any = most(any, thin);
    }
  if (!any_positive(any)) return false;
  const bool inside = frame.all(REACH + 2);
  if (!inside) frame.repeat(w.thin, MIDDLE, REACH + 1);
  for (int i = 0; i < NEAREST; i++)
    for (int j = 0; j < NEAREST; j += LANES) {
      const float *t = w.thin + i * PITCH + j;
      vec touching = {};
      for (int r = 0; r < 3; r++, t += PITCH) touching = most(most(load<vec>(t), load<vec>(t + 1)), most(load<vec>(t + 2), touching));
      vec clear = 1.0f - touching;
      if (valid) clear *= load<vec>(counted + (i + 2) * PITCH + j + 2);
      store(w.clear + i * PITCH + j, clear);
    }
  if (!inside) frame.repeat(w.clear, NEAREST, REACH);
  return true;
}

// Sums of what shows a strand along rows, for the pixels in their middle.
void sum_rows(const Around &taps, float low, Strands::Maps &w) {
  for (int i = 0; i < NEAREST; i++)
    for (int x = 0; x < BLOCK; x += LANES) {
      const float *thin = w.thin + (i + 1) * PITCH + x + 1, *coc = w.coc + (i + 2) * PITCH + x + 2;
      vec amount = {}, cocs = {}, right = {}, square = {};
      if (any_positive(most(load<vec>(thin), load<vec>(thin + SIDE - 1))) || LANES < SIDE - 1)
        for (int d = 0; d < SIDE; d++) {
          const float off = (float)(d - REACH);
          const vec shown = load<vec>(thin + d) * taps.along[d];
          amount += shown;
          cocs += shown * (load<vec>(coc + d) - low);  // rounding must not make a strand nearer than all else
          right += shown * off;
          square += shown * (off * off);
        }
      const vec found[4] = {amount, cocs, right, square};
      for (int k = 0; k < 4; k++) store(w.line[k] + i * BLOCK + x, found[k]);
    }
}

// The light around a block.
void gather_light(const Job &job, const Inside &frame, Strands::Maps &w) {
  for (int c = 0; c < job.channels; c++)
    frame.copy(job.surfaces.light + c * job.surfaces.area(), w.light.data() + (size_t)c * NEAREST * PITCH, NEAREST, REACH);
  for (int i = 0; i < NEAREST; i++)
    for (int j = 0; j < NEAREST; j += LANES) {
      vec size = {};
      for (int c = 0; c < job.channels; c++) {
        const vec v = load<vec>(w.light.data() + ((size_t)c * NEAREST + i) * PITCH + j);
        size = most(size, size_of(v));
      }
      store(w.size + i * PITCH + j, size);
    }
}

// Sums of a strand, and of what is behind it, around the batch's next pixel; false if nothing is.
template <int CHANNELS>
bool sum_around(const Job &job, const Around &taps, Strands::Maps &w, int y, int x, float strand_coc) {
  Batch &b = w.batch;
  const int C = CHANNELS ? CHANNELS : job.channels, n = b.count;
  vec behind[SIDE][PARTS], shown[SIDE][PARTS], size = {}, total[PARTS] = {}, down[PARTS] = {}, square[PARTS] = {};
  for (int r = 0; r < SIDE; r++)
    for (int p = 0; p < PARTS; p++) {
      const int at = (y + r) * PITCH + x + p * LANES;
      const vec farther = least(most(load<vec>(w.coc + at + 2 * PITCH + 2) - (strand_coc + 1.0f), vec{}), taps.counts[p]);
      size = most(size, load<vec>(w.size + at) * taps.counts[p]);
      const vec part = behind[r][p] = load<vec>(w.clear + at) * farther * taps.falloff[r][p];
      shown[r][p] = load<vec>(w.thin + at + PITCH + 1) * taps.falloff[r][p];
      const float off = (float)(r - REACH);
      total[p] += part;
      down[p] += part * off;
      square[p] += part * (off * off);
    }
  vec seen = {};
  for (int p = 0; p < PARTS; p++) seen += total[p];
  if (!any_positive(seen)) return false;
  auto put = [&](int k, vec v) { b.around[k * LANES + n] = v; };
  vec d = {}, rr = {}, x1 = {}, x2 = {}, dx = {};
  for (int p = 0; p < PARTS; p++) {
    d += down[p];
    rr += square[p];
    x1 += total[p] * taps.right[p];
    x2 += total[p] * taps.right[p] * taps.right[p];
    dx += down[p] * taps.right[p];
  }
  put(Batch::TOTAL, seen);
  put(Batch::DOWN, d);
  put(Batch::RIGHT, x1);
  put(Batch::DOWN_DOWN, rr);
  put(Batch::RIGHT_RIGHT, x2);
  put(Batch::DOWN_RIGHT, dx);
  const float scale = std::max(largest(size), TINY), per_scale = 1.0f / scale;
  vec squares = {};
  for (int c = 0; c < C; c++) {
    const float *light = w.light.data() + ((size_t)c * NEAREST + y) * PITCH + x;
    vec lights = {};
    for (int r = 0; r < SIDE; r++)
      for (int p = 0; p < PARTS; p++) lights += load<vec>(light + r * PITCH + p * LANES) * per_scale * behind[r][p];
    const float mean = sum(lights) / sum(seen);
    vec lower = {}, righter = {}, strand = {};  // of what differs from it, else rounding beside a lamp would be texture
    for (int p = 0; p < PARTS; p++) {
      vec column = {};
      for (int r = 0; r < SIDE; r++) {
        const vec v = load<vec>(light + r * PITCH + p * LANES) * per_scale - mean, part = v * behind[r][p];
        column += part;
        lower += part * (float)(r - REACH);
        squares += part * v;
        strand += v * shown[r][p];
      }
      righter += column * taps.right[p];
    }
    const int k = Batch::OF_COLOURS + Batch::A_COLOUR * c;
    put(k + Batch::LIGHT_DOWN, lower);
    put(k + Batch::LIGHT_RIGHT, righter);
    put(k + Batch::STRAND, strand);
    b.mean[c][n] = mean;
    b.colour[c][n] = light[REACH * PITCH + REACH] * per_scale;
  }
  put(Batch::SQUARE, squares);
  b.scale[n] = scale;
  return true;
}

// Splits the pixels of a batch between the strand and what is behind it, as far as they are sure.
template <int CHANNELS>
void split(Job &job, Batch &b, int which) {
  const int C = CHANNELS ? CHANNELS : job.channels;
  auto sum_at = [&](int k) {
    float totals[LANES];
    sum(b.around.data() + k * LANES, LANES, totals);
    return load<vec>(totals);
  };
  for (int n = b.count; n < LANES; n++) b.sureness[n] = 0, b.scale[n] = 1;

  // a plane through the light behind the strand, at each pixel; the strand's light, and how much of it is here
  const vec total = sum_at(Batch::TOTAL), per = 1.0f / most(total, all(1e-12f)), y = sum_at(Batch::DOWN) * per, x = sum_at(Batch::RIGHT) * per;
  const vec yy = sum_at(Batch::DOWN_DOWN) * per - y * y, xx = sum_at(Batch::RIGHT_RIGHT) * per - x * x, xy = sum_at(Batch::DOWN_RIGHT) * per - y * x;
  const vec level_yy = yy + LEVEL, level_xx = xx + LEVEL, per_spread = 1.0f / (level_yy * level_xx - xy * xy);
  const vec per_amount = 1.0f / most(b.amount, all(1e-12f));
  vec texture = sum_at(Batch::SQUARE) * per, strength = {}, along = {};
  for (int c = 0; c < C; c++) {
    const int k = Batch::OF_COLOURS + Batch::A_COLOUR * c;
    const vec down = sum_at(k + Batch::LIGHT_DOWN) * per, right = sum_at(k + Batch::LIGHT_RIGHT) * per;
    const vec slope_y = (down * level_xx - right * xy) * per_spread, slope_x = (right * level_yy - down * xy) * per_spread;
    texture += slope_y * slope_y * yy + slope_x * slope_x * xx + 2.0f * slope_y * slope_x * xy - 2.0f * (slope_y * down + slope_x * right);
    const vec off = -(slope_y * y + slope_x * x), contrast = sum_at(k + Batch::STRAND) * per_amount - off;
    b.back[c] = b.mean[c] + off;
    b.front[c] = b.back[c] + contrast;
    strength += contrast * contrast;
    along += (b.colour[c] - b.back[c]) * contrast;
  }
  const vec fitted = along / most(strength, all(1e-12f)), weight = least(most(fitted, vec{}), all(MOST_COVERED));
  vec sureness = b.sureness * least(SEEN * total, all(1.0f)) * clamp01(weight / LEAST_COVERED - 1.0f);
  sureness *= clamp01(2.0f - fitted);  // it covers no more than where depth shows it: else a lamp
  sureness *= strength / (strength + TRUST * most(texture, vec{}) + ALIKE * ALIKE);

  // in doubt the surfaces are what they were
  if (!any_positive(sureness)) return;
  const vec per_scale = 1.0f / b.scale;
  for (int c = 0; c < C; c++)
    b.front[c] = other_light(job, c, b.colour[c], weight, b.back[c], b.front[c], per_scale) * b.scale;
  const Block block = job.surfaces.make_block(which);
  Buffer<float> &joined = job.surfaces.joined[which];
  if (!joined.data()) {
    joined = Buffer<float>(BLOCK_PIXELS);
    memset(joined.data(), 0, BLOCK_PIXELS * sizeof(float));
  }
  for (int n = 0; n < b.count; n++) {
    if (!(sureness[n] > 0)) continue;
    const int at = b.y[n] * BLOCK + b.x[n];
    const float was = block.weight[at], mixed = was + sureness[n] * (weight[n] - was), known = std::max(mixed, 1e-12f);
    for (int c = 0; c < C; c++) {
      float &own = block.own[c * BLOCK_PIXELS + at], &other = block.other[c * BLOCK_PIXELS + at];
      const float before = was * other, moved = before + sureness[n] * (b.front[c][n] - before);
      own = (b.colour[c][n] * b.scale[n] - moved) / (1.0f - mixed);
      other = moved / known;
    }
    block.coc[at] += sureness[n] * weight[n] / known * (b.coc[n] - block.coc[at]);
    block.weight[at] = mixed;
    joined[at] = std::max(mixed - was, 0.0f);
    block.seen[at] = 1.0f - mixed;
  }
}

// Looks for pixels of a block that lie on the line of a strand.
template <int CHANNELS>
void join_strands(Job &job, Strands::Maps &w, const Inside &frame, float low, int which) {
  static const Around taps;
  sum_rows(taps, low, w);
  Batch &b = w.batch;
  const bool may_be_lamp = job.block_peak[which] > least_threshold(job, frame.y0, frame.x0);
  bool lit = false;
  for (int y = 0; y < std::min(BLOCK, frame.height - frame.y0); y++)
    for (int x = 0; x < BLOCK; x += LANES) {
      vec found[4] = {}, down = {}, down_down = {}, down_right = {};
      for (int r = 0; r < SIDE; r++) found[0] += load<vec>(w.line[0] + (y + r) * BLOCK + x) * taps.along[r];
      if (!any_positive(found[0])) continue;
      const vec own_coc = load<vec>(w.coc + (y + REACH + 2) * PITCH + x + REACH + 2), per = 1.0f / most(found[0], all(1e-12f));
      for (int r = 0; r < SIDE; r++) found[1] += load<vec>(w.line[1] + (y + r) * BLOCK + x) * taps.along[r];
      const vec coc = low + found[1] * per;
      vec sureness = clamp01(own_coc - coc - 1.0f) * least(SEEN * found[0], all(1.0f));
      if (!any_positive(sureness)) continue;
      for (int r = 0; r < SIDE; r++) {
        const float off = (float)(r - REACH);
        const vec amount = load<vec>(w.line[0] + (y + r) * BLOCK + x) * taps.along[r];
        const vec right = load<vec>(w.line[2] + (y + r) * BLOCK + x) * taps.along[r];
        down += amount * off;
        down_down += amount * (off * off);
        found[2] += right;
        down_right += right * off;
        found[3] += load<vec>(w.line[3] + (y + r) * BLOCK + x) * taps.along[r];
      }
      const vec down_by = down * per, right_by = found[2] * per;
      const vec yy = down_down * per - down_by * down_by + WIDTH, xx = found[3] * per - right_by * right_by + WIDTH;
      const vec xy = down_right * per - down_by * right_by;
      const vec spread = yy * xx - xy * xy;
      const vec aside = (right_by * right_by * yy + down_by * down_by * xx - 2.0f * right_by * down_by * xy) / spread;
      sureness *= clamp01(2.0f - aside) * clamp01(2.0f - spread / (yy + xx) / NARROW);
      if (!any_positive(sureness)) continue;
      if (!lit) gather_light(job, frame, w);
      lit = true;
      for (int i = 0; i < std::min(LANES, frame.width - frame.x0 - x); i++) {
        if (job.surfaces.valid && !(job.surfaces.valid[(size_t)(frame.y0 + y) * frame.width + frame.x0 + x + i] > 0)) continue;
        float sure = sureness[i];
        if (may_be_lamp) {
          const float *light = w.light.data() + (y + REACH) * PITCH + x + i + REACH;
          sure *= clamp01(2.0f - peak_of(light, NEAREST * PITCH, job.channels) / std::max(threshold_at(job, frame.y0 + y, frame.x0 + x + i), TINY));
        }
        if (!(sure > 0) || !sum_around<CHANNELS>(job, taps, w, y, x + i, coc[i])) continue;
        b.y[b.count] = y;
        b.x[b.count] = x + i;
        b.coc[b.count] = coc[i];
        b.amount[b.count] = found[0][i];
        b.sureness[b.count++] = sure;
        if (b.count < LANES) continue;
        split<CHANNELS>(job, b, which);
        b.count = 0;
      }
    }
  if (b.count) split<CHANNELS>(job, b, which);
  b.count = 0;
}

}  // namespace

Strands::Strands(int channels) : maps_(new Maps()) {
  maps_->light.assign((size_t)channels * NEAREST * PITCH + LANES, 0.0f);
  Batch &b = maps_->batch;
  b.around.resize((size_t)(Batch::OF_COLOURS + Batch::A_COLOUR * channels) * LANES);
  for (auto *v : {&b.mean, &b.back, &b.front, &b.colour}) v->resize(channels);
}
Strands::~Strands() = default;

void Strands::join(Job &job, int by, int bx, float low) {
  const Inside frame{by * BLOCK, bx * BLOCK, job.height, job.width};
  if (!find_strands(job, frame, *maps_)) return;
  const int which = by * job.surfaces.block_columns + bx;
  job.channels == 3 ? join_strands<3>(job, *maps_, frame, low, which) : join_strands<0>(job, *maps_, frame, low, which);
}

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
