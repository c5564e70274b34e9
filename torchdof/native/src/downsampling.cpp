// Downsampling: means of the surfaces over blocks of s x s pixels, computed once for all layers of scale s.
//
// A layer's share of a pixel depends linearly on the pixel's position t between two nodes (0 at the first, 1 at the
// second). The means of weight w and light, and of w t and light t, over the pixels between each two nodes are
// therefore enough: the layer at the first node takes mean(w) - mean(w t), the one at the second takes mean(w t).
// In the code, `sums` are without t, and `sums_behind` with t: of the parts that lie behind the first node.
#include "downsampling.h"

#include <algorithm>
#include <cstdint>
#include <cstring>
#include <vector>

#include "blocks.h"
#include "border.h"
#include "job.h"
#include "layers.h"
#include "memory.h"
#include "rules.h"
#include "simd.h"
#include "surfaces.h"

namespace torchdof {

class Downsampling {
 public:
  Downsampling(const Job &job, const LayerIndex &index, const Border &border, Downsampled &to)
      : job_(job), s_(job.surfaces), index_(index), border_(border), over_(job.scene.occlusion), to_(to),
        C_(job.channels), stride_(to.stride()), each_(1.0f / (to.scale * to.scale)), light_(C_),
        light_of_{light_, light_}, beyond_((size_t)2 * C_ * BLOCK_PIXELS) {}

  // Computes all blocks of a band of BLOCK rows of pixels.
  void band(int band) {
    const int s = to_.scale, first = band * (BLOCK / s);
    Pieces &pieces = to_.pieces[band - to_.first_band];
    for (int row = first; row < first + BLOCK / s; row++) {
      pieces.start.push_back((int)pieces.column.size());
      if (row < -to_.margin || row >= to_.rows + to_.margin) continue;
      const uint8_t *near = &to_.near[(size_t)std::clamp(band, 0, s_.block_rows - 1) * s_.block_columns];
      int column = -to_.margin;
      while (column < to_.columns + to_.margin) {
        // up to the next block of the image, or in the margin
        const int block_of = std::clamp(floor_div(column * s, BLOCK), 0, s_.block_columns - 1);
        int end = block_of + 1 == s_.block_columns ? to_.columns + to_.margin : (block_of + 1) * BLOCK / s;
        if (!near[block_of]) {
          std::fill(to_.row(0, row) + column, to_.row(0, row) + end, FARTHEST);
          std::fill(to_.row(1, row) + column, to_.row(1, row) + end, 1.0f);
          column = end;
        }
        while (column < end)
          column = s == 2   ? cell<2>(row, column, end, pieces)
                   : s == 4 ? cell<4>(row, column, end, pieces)
                   : s == 8 ? cell<8>(row, column, end, pieces)
                            : cell<16>(row, column, end, pieces);
      }
      std::fill(to_.row(0, row) + column, to_.row(0, row) - to_.margin + to_.pitch, NOWHERE);
    }
    pieces.start.push_back((int)pieces.column.size());
  }

 private:
  // Values in place of a node: of empty blocks, and of blocks that no layer of this scale uses.
  static constexpr float NOWHERE = -2.0f, FARTHEST = 1e6f;

  // Block means of a cell whose pixels show one surface between the same two nodes.
  template <int S>
  void cell_means(int row, int column, int k) {
    constexpr int PARTS = CELL / LANES, COUNT = CELL / S;
    const int y0 = row * S, x0 = column * S;
    const size_t light_step = s_.has_block(s_.block_of(y0, x0)) ? BLOCK : s_.width;
    const float *coc, *weight;
    s_.row(0, y0, x0, light_.data(), coc, weight);
    auto put = [&](int plane, const vec *sum) {  // means of S neighbours
      float columns_of[CELL], *to = to_.row(plane, row) + column;
      for (int p = 0; p < PARTS; p++) store(columns_of + p * LANES, sum[p] * each_);
      for (int j = 0; j < COUNT; j++) {
        to[j] = columns_of[j * S];
        for (int x = 1; x < S; x++) to[j] += columns_of[j * S + x];
      }
    };
    std::fill(to_.row(0, row) + column, to_.row(0, row) + column + COUNT, (float)to_.stands_for[k]);
    std::fill(to_.row(1, row) + column, to_.row(1, row) + column + COUNT, 1.0f);
    if (!to_.wanted[k]) return;
    vec far[S][PARTS], sums[PARTS], sums_behind[PARTS] = {};
    for (int y = 0; y < S; y++)
      for (int p = 0; p < PARTS; p++)
        sums_behind[p] += far[y][p] =
            behind(job_.layers[k], index_.place(load<vec>(coc + y * s_.width + p * LANES)), over_);
    put(C_ + 2, sums_behind);
    for (int c = 0; c < C_; c++) {
      for (int p = 0; p < PARTS; p++) sums[p] = sums_behind[p] = vec{};
      for (int y = 0; y < S; y++)
        for (int p = 0; p < PARTS; p++) {
          const vec v = load<vec>(light_[c] + y * light_step + p * LANES);
          sums[p] += v;
          sums_behind[p] += v * far[y][p];
        }
      put(2 + c, sums);
      put(3 + C_ + c, sums_behind);
    }
  }

  // Computes the blocks of a row from `column` to the end of their cell (or larger block), at most to `end`: one
  // interval at a time, whole vectors of pixels. Returns the next column.
  template <int S>
  int cell(int row, int column, int end, Pieces &pieces) {
    constexpr int WIDTH = S > CELL ? S : CELL, COUNT = WIDTH / S;
    typedef uint16_t halves __attribute__((vector_size(LANES * 2)));
    const int first = floor_div(column, COUNT) * COUNT, y0 = row * S, x0 = first * S;
    end = std::min(end, first + COUNT);
    const bool inside = y0 >= 0 && x0 >= 0 && y0 + S <= s_.height && x0 + WIDTH <= s_.width;
    if constexpr (S <= CELL) {
      const size_t cell = (size_t)(y0 / CELL) * index_.columns + x0 / CELL;
      const int k = inside && index_.single[cell] ? index_.only_interval(cell) : -1;
      if (k >= 0) {
        cell_means<S>(row, column, k);
        return end;
      }
    }
    int there = 0;
    for (; there < s_.count; there++) {
      const float *coc, *weight;
      if (!inside) {
        if (!read_beyond<S>(there, y0, x0, column - first, end - first)) break;
        continue;
      }
      if (!s_.row(there, y0, x0, light_of_[there].data(), coc, weight)) break;
      const uint16_t *intervals = &index_.intervals[there][s_.pixel(y0, x0)];
      for (int y = 0, i = 0; y < S; y++, coc += there ? BLOCK : s_.width, intervals += s_.width)
        for (int x = 0; x < WIDTH; x += LANES, i += LANES) {
          halves of_row;
          memcpy(&of_row, intervals + x, sizeof(of_row));
          store(interval_[there] + i, __builtin_convertvector(of_row, ivec));
          store(weight_[there] + i, weight ? load<vec>(weight + y * BLOCK + x) : broadcast(1.0f));
          store(coc_[there] + i, load<vec>(coc + x));
        }
    }
    const bool continues = there == 2 && mixed(y0, x0) && continue_farther(S * WIDTH);
    const size_t light_step = !inside ? WIDTH : s_.has_block(s_.block_of(y0, x0)) ? BLOCK : s_.width;
    cell_nodes_.clear();
    for (int i = 0; i < there; i++)
      continues ? sum_intervals<S, true>(i, light_step, before_[i], after_[i])
                : sum_intervals<S, false>(i, light_step, weight_[i], weight_[i]);
    for (int i = 0; continues && i < (int)corrections_.size(); i++) {
      const NormalizerCorrection &of = corrections_[i];
      float *sums =
          &cell_sums_[cell_sums_of(to_.stands_for[of.node] | Pieces::NORMALIZER_ONLY, COUNT)] + of.pixel % WIDTH / S;
      sums[0] += of.up_to * each_;
      sums[(C_ + 1) * COUNT] += of.next * each_;
    }
    for (; column < end; column++) put_sums<COUNT>(row, column, column - first, pieces);
    return end;
  }

  // Puts the sums of a block, which is the n-th of its cell: its first interval into the planes, others into the
  // pieces.
  template <int COUNT>
  void put_sums(int row, int column, int n, Pieces &pieces) {
    to_.row(0, row)[column] = NOWHERE;
    for (size_t i = 0; i < cell_nodes_.size(); i++) {
      const float *values = &cell_sums_[i * stride_ * COUNT] + n;
      const bool normalizer_only = cell_nodes_[i] & Pieces::NORMALIZER_ONLY;
      if (*values == 0 && !(normalizer_only && values[(C_ + 1) * COUNT] != 0)) continue;
      if (normalizer_only || to_.row(0, row)[column] != NOWHERE) {
        pieces.column.push_back(column);
        pieces.node.push_back(cell_nodes_[i]);
        for (int v = 0; v < stride_; v++) pieces.values.push_back(values[v * COUNT]);
      } else {
        to_.row(0, row)[column] = (float)cell_nodes_[i];
        for (int v = 0; v < stride_; v++) to_.row(1 + v, row)[column] = values[v * COUNT];
      }
    }
  }

  // Reads blocks of a cell that lies at least partly beyond the frame; the others get the weight 0. Beside one edge of
  // the frame coc and weight do not change away from it, and the pixels of a line get its mean light. False if all
  // weights are 0.
  template <int S>
  bool read_beyond(int surface, int y0, int x0, int first, int last) {
    constexpr int WIDTH = S > CELL ? S : CELL;
    const int H = s_.height, W = s_.width;
    float *const coc = coc_[surface], *const weight = weight_[surface], any = 0;
    int32_t *const interval = interval_[surface];
    for (int i = 0; last - first < WIDTH / S && i < S * WIDTH; i++) coc[i] = weight[i] = 0.0f, interval[i] = 0;
    for (int c = 0; c < C_; c++) light_of_[surface][c] = &beyond_[(size_t)(surface * C_ + c) * BLOCK_PIXELS];
    for (int block = first; block < last; block++) {
      const int left = x0 + block * S;
      const bool above_or_below = left >= 0 && left + S <= W && (y0 + S <= 0 || y0 >= H);
      const bool beside = y0 >= 0 && y0 + S <= H && (left + S <= 0 || left >= W);
      for (int row = 0; row < (above_or_below ? 1 : S); row++)
        for (int column = 0; column < (beside ? 1 : S); column++) {
          const int y = y0 + row, x = left + column, at_y = std::clamp(y, 0, H - 1), at_x = std::clamp(x, 0, W - 1);
          const int i = row * WIDTH + block * S + column;
          const float *its_coc, *its_weight;
          const bool there = s_.row(surface, at_y, at_x, light_.data(), its_coc, its_weight);
          coc[i] = there ? *its_coc : 0.0f;
          any += weight[i] = !there ? 0.0f : its_weight ? *its_weight : 1.0f;
          interval[i] = index_.intervals[surface][s_.pixel(at_y, at_x)];
          if (weight[i] == 0 || !to_.wanted[interval[i]]) continue;  // no layer needs its light
          for (int c = 0; c < C_; c++) {
            const float nearest = *light_[c];
            float &light = beyond_[(size_t)(surface * C_ + c) * BLOCK_PIXELS + i];
            if (above_or_below || beside)
              light = border_.mean_light(surface, c, y, x, S, nearest);
            else
              light = y == at_y && x == at_x ? nearest : border_.light(surface, c, y, x, nearest);
          }
        }
      const auto repeat = [&](auto *plane) {  // along the lines
        plane += block * S;
        for (int row = 0; row < S; row++) {
          if (beside) std::fill(plane + row * WIDTH + 1, plane + row * WIDTH + S, plane[row * WIDTH]);
          if (above_or_below && row) std::copy(plane, plane + S, plane + row * WIDTH);
        }
      };
      repeat(coc);
      repeat(weight);
      repeat(interval);
      for (int c = 0; c < C_; c++) repeat(&beyond_[(size_t)(surface * C_ + c) * BLOCK_PIXELS]);
    }
    return any != 0;
  }

  // Sums the pixels of a surface. before, after: their weights in the layers before and after each pixel; equal unless
  // MIXED.
  template <int S, bool MIXED>
  void sum_intervals(int surface, size_t light_step, const float *before, const float *after) {
    constexpr int WIDTH = S > CELL ? S : CELL, PARTS = WIDTH / LANES, COUNT = WIDTH / S, DONE = -1;
    const int C = C_;
    vec place[S][PARTS], share[S][PARTS], part[S][PARTS] = {};
    ivec interval[S][PARTS], last = ivec{} + DONE;
    for (int y = 0; y < S; y++)
      for (int p = 0; p < PARTS; p++) {
        const int i = y * WIDTH + p * LANES;
        place[y][p] = index_.place(load<vec>(coc_[surface] + i));
        interval[y][p] = load<vec>(weight_[surface] + i) != vec{} ? load<ivec>(interval_[surface] + i) : ivec{} + DONE;
        last = max(last, interval[y][p]);
      }
    for (;;) {
      int k = DONE;
      for (int lane = 0; lane < LANES; lane++) k = std::max(k, (int)last[lane]);
      if (k == DONE) return;
      vec sums[PARTS] = {}, sums_behind[PARTS] = {};
      last = ivec{} + DONE;
      for (int y = 0; y < S; y++)
        for (int p = 0; p < PARTS; p++) {
          const int i = y * WIDTH + p * LANES;
          const auto its = interval[y][p] == k;
          const vec first = its ? load<vec>(before + i) : vec{};
          share[y][p] = first;
          if (to_.wanted[k]) {
            const vec far = behind(job_.layers[k], place[y][p], over_),
                      second = MIXED ? its ? load<vec>(after + i) : vec{} : first;
            if (MIXED) share[y][p] += far * (second - first);
            sums_behind[p] += part[y][p] = far * second;
          }
          sums[p] += share[y][p];
          interval[y][p] = its ? ivec{} + DONE : interval[y][p];
          last = max(last, interval[y][p]);
        }
      if (!to_.needed(k)) continue;
      const size_t start = cell_sums_of(to_.stands_for[k], COUNT);
      auto put = [&](int value, const vec *sum) {  // adds sums of S neighbours
        float columns_of[WIDTH], *to = cell_sums_.data() + start + value * COUNT;
        for (int p = 0; p < PARTS; p++) store(columns_of + p * LANES, sum[p] * each_);
        for (int x = 0; x < WIDTH; x++) to[x / S] += columns_of[x];
      };
      put(0, sums);
      if (!to_.wanted[k]) continue;
      put(C + 1, sums_behind);
      for (int c = 0; c < C; c++) {
        for (int p = 0; p < PARTS; p++) sums[p] = sums_behind[p] = vec{};
        for (int y = 0; y < S; y++)
          for (int p = 0; p < PARTS; p++) {
            const vec v = load<vec>(light_of_[surface][c] + y * light_step + p * LANES);
            sums[p] += v * share[y][p];
            sums_behind[p] += v * part[y][p];
          }
        put(1 + c, sums);
        put(C + 2 + c, sums_behind);
      }
    }
  }

  // Index of a node's sums [stride, count]; adds them if they are missing.
  size_t cell_sums_of(int node, int count) {
    const size_t size = (size_t)stride_ * count,
                 i = std::find(cell_nodes_.begin(), cell_nodes_.end(), node) - cell_nodes_.begin();
    if (i == cell_nodes_.size()) {
      cell_nodes_.push_back(node);
      cell_sums_.resize(std::max(cell_sums_.size(), (i + 1) * size));
      std::fill(&cell_sums_[i * size], &cell_sums_[i * size] + size, 0.0f);
    }
    return i * size;
  }

  // Whether a block, clamped to the frame, touches cells with mixed pixels.
  bool mixed(int y0, int x0) const {
    auto cell = [&](int at, int size) { return std::clamp(at, 0, size - 1) / CELL; };
    const int H = job_.height, W = job_.width, end = to_.scale - 1;
    for (int row = cell(y0, H); row <= cell(y0 + end, H); row++)
      for (int column = cell(x0, W); column <= cell(x0 + end, W); column++)
        if (index_.mixed[(size_t)row * index_.columns + column]) return true;
    return false;
  }

  // Position of pixels of a surface between their two nodes, 0 to 1.
  vec far_between(int surface, int i) const {
    vec at, per;
    for (int lane = 0; lane < LANES; lane++) {
      const Layer &before = job_.layers[interval_[surface][i + lane]];
      at[lane] = before.at, per[lane] = before.per_after;
    }
    return ramp((index_.place(load<vec>(coc_[surface] + i)) - at) * per, over_);
  }

  // Weights of both surfaces of each pixel in the layers before and after it. The farther surface of a mixed pixel
  // continues behind the nearer one and gets extra weight there. In the layers up to the nearer surface this extra
  // weight is subtracted from the normalizer. False if no pixel needs it.
  bool continue_farther(int count) {
    corrections_.clear();
    bool any = false;
    for (int i = 0; i < count; i += LANES) {
      const vec weight[2] = {load<vec>(weight_[0] + i), load<vec>(weight_[1] + i)};
      const auto other_is_nearer = load<vec>(coc_[1] + i) < load<vec>(coc_[0] + i);
      const vec share = other_is_nearer ? weight[0] : weight[1], extra = continuation(share), whole = share + extra;
      for (int surface = 0; surface < 2; surface++)
        store(before_[surface] + i, weight[surface]), store(after_[surface] + i, weight[surface]);
      if (!any_positive(extra)) continue;
      any = true;
      const vec fars[2] = {far_between(0, i), far_between(1, i)};
      const vec of_near = other_is_nearer ? fars[1] : fars[0], of_far = other_is_nearer ? fars[0] : fars[1];
      const ivec interval[2] = {load<ivec>(interval_[0] + i), load<ivec>(interval_[1] + i)};
      const ivec k = other_is_nearer ? interval[1] : interval[0], n = other_is_nearer ? interval[0] : interval[1];
      const vec next = share + extra * visible_part(of_near);  // in layer k + 1
      const vec first = n == k ? share : n == k + 1 ? next : whole, second = n == k ? next : whole;
      store(before_[0] + i, other_is_nearer ? first : weight[0]);
      store(after_[0] + i, other_is_nearer ? second : weight[0]);
      store(before_[1] + i, other_is_nearer ? weight[1] : first);
      store(after_[1] + i, other_is_nearer ? weight[1] : second);
      for (int lane = 0; lane < LANES; lane++) {
        const int nearer = k[lane], farther = n[lane];
        if (!(extra[lane] > 0) || !to_.needed(nearer)) continue;
        const float given = first[lane] + (to_.wanted[farther] ? of_far[lane] : 0.0f) * (second[lane] - first[lane]);
        const bool shows_next = to_.wanted[nearer] && farther > nearer;
        corrections_.push_back({i + lane, nearer, share[lane] - given, shows_next ? next[lane] - given : 0.0f});
      }
    }
    return any;
  }

  const Job &job_;
  const Surfaces &s_;
  const LayerIndex &index_;
  const Border &border_;
  const bool over_;
  Downsampled &to_;
  const int C_, stride_;
  const float each_;
  struct NormalizerCorrection {
    int pixel, node;    // index in the cell; node before the pixel's nearer surface
    float up_to, next;  // correction of the normalizer in the layers up to that node, and in the next one
  };
  // For a cell's pixels and both surfaces. before, after: weight in the layers before and after the pixel.
  float coc_[2][BLOCK_PIXELS], weight_[2][BLOCK_PIXELS], before_[2][BLOCK_PIXELS], after_[2][BLOCK_PIXELS];
  int32_t interval_[2][BLOCK_PIXELS];
  std::vector<NormalizerCorrection> corrections_;
  std::vector<int> cell_nodes_;   // nodes in a row of blocks,
  std::vector<float> cell_sums_;  // and their values in the layout of pieces [nodes, stride, blocks]
  std::vector<const float *> light_, light_of_[2];
  std::vector<float> beyond_;  // light of pixels in a cell beyond the frame [2, channels, BLOCK_PIXELS]
};

Downsampled::Downsampled(const Job &job, int scale, int margin)
    : scale(scale), margin(margin), rows(ceil_div(job.height, scale)), columns(ceil_div(job.width, scale)),
      channels(job.channels) {
  const int per_band = BLOCK / scale;
  pitch = (columns + 2 * margin + 15) / 16 * 16 + 32;  // rows are read in whole vectors
  size = (size_t)(rows + 2 * margin) * pitch;
  planes = Buffer<float>(size * (3 + 2 * channels));
  first_band = -ceil_div(margin, per_band);
  pieces.resize(ceil_div(rows + margin, per_band) - first_band);
  // intervals that no layer of this scale blurs or composites over are left out
  const int layers = (int)job.layers.size();
  wanted.resize(layers), behind.resize(layers), stands_for.resize(layers);
  for (int k = 0, class_of = 0; k < layers; k++) {
    const bool here = job.layers[k].scale == scale, next = k + 1 < layers && job.layers[k + 1].scale == scale;
    wanted[k] = here || next;
    behind[k] = here || (k && behind[k - 1]);
    if (wanted[k] || (k && wanted[k - 1])) class_of = k;  // all intervals between two runs lie behind the same layers
    stands_for[k] = (uint16_t)class_of;
  }
  if (!job.scene.occlusion) behind = wanted;
}

void Downsampled::take(const Job &job, const LayerIndex &index, const Border &border) {
  // blocks that layers of this scale may need: within twice the reach of a block in which one of them occurs
  const int cells = BLOCK / CELL, block_rows = job.surfaces.block_rows, block_columns = job.surfaces.block_columns;
  std::vector<uint64_t> layers(index.words, 0);
  for (int k = 0; k < (int)job.layers.size(); k++)
    if (job.layers[k].scale == scale) layers[k / 64] |= 1ull << k % 64;
  std::vector<uint8_t> occupied((size_t)block_rows * block_columns, 0);
  for (int row = 0; row < index.rows; row++)
    for (int column = 0; column < index.columns; column++)
      for (int w = 0; w < index.words; w++)
        if (index.cell((size_t)row * index.columns + column)[w] & layers[w])
          occupied[(size_t)(row / cells) * block_columns + column / cells] = 1;
  const int reach = ceil_div(2 * margin * scale, BLOCK);
  auto widen = [](const uint8_t *from, uint8_t *to, int count, int step, int reach) {
    for (int i = 0, last = -reach - 1; i < count + reach; i++) {  // last: latest occupied index up to i
      if (i < count && from[(size_t)i * step]) last = i;
      if (i >= reach) to[(size_t)(i - reach) * step] = last >= i - 2 * reach && last >= 0;
    }
  };
  near.resize(occupied.size());
  for (int row = 0; row < block_rows; row++)
    widen(&occupied[(size_t)row * block_columns], &near[(size_t)row * block_columns], block_columns, 1, reach);
  occupied.swap(near);
  for (int column = 0; column < block_columns; column++)
    widen(&occupied[column], &near[column], block_rows, block_columns, reach);
  job.parallel((int)pieces.size(),
               [&](int band, int) { Downsampling(job, index, border, *this).band(first_band + band); });
}

}  // namespace torchdof
