// Downsampling: means of the surfaces over blocks of s x s pixels, computed once for all layers of scale s.
//
// A layer's share of a pixel depends linearly on the pixel's position t between two nodes (0 at the first, 1 at the
// second). The means of weight w and light, and of w t and light t, over the pixels between each two nodes are
// therefore enough: the layer at the first node takes mean(w) - mean(w t), the one at the second takes mean(w t).
// In the code, `sums` are without t, and `sums_behind` with t: of the parts that lie behind the first node.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

// Sums over a block's pixels, one set of values for each interval between nodes.
struct Gathered {
  int count = 0;
  std::vector<int> nodes;
  std::vector<float> values;
  explicit Gathered(int stride) : stride(stride) {}
  float *between(int node) {
    for (int i = 0; i < count; i++)
      if (nodes[i] == node) return &values[(size_t)i * stride];
    if (count == (int)nodes.size()) {
      nodes.push_back(0);
      values.resize(values.size() + stride);
    }
    nodes[count] = node;
    float *made = &values[(size_t)count++ * stride];
    std::fill(made, made + stride, 0.0f);
    return made;
  }

 private:
  const int stride;
};

}  // namespace

class Downsampling {
 public:
  Downsampling(const Job &job, const LayerIndex &index, const Border &border, Downsampled &to)
      : job_(job), s_(job.surfaces), index_(index), border_(border), over_(job.scene.occlusion), to_(to), C_(job.channels), stride_(to.stride()), each_(1.0f / (to.scale * to.scale)),
        gathered_(stride_), light_(C_), light_of_{light_, light_} {
    for (const Layer &l : job.layers) ramps_.push_back({l.at, l.per_after});
  }

  // Computes all blocks of a band of BLOCK rows of pixels.
  void band(int band) {
    const int s = to_.scale, first = band * (BLOCK / s), columns = job_.width / s;
    Pieces &pieces = to_.pieces[band - to_.first_band];
    for (int row = first; row < first + BLOCK / s; row++) {
      pieces.start.push_back((int)pieces.column.size());
      if (row < -to_.margin || row >= to_.rows + to_.margin) continue;
      const bool inside = row >= 0 && (row + 1) * s <= job_.height;
      const uint8_t *near = &to_.near[(size_t)std::clamp(band, 0, s_.block_rows - 1) * s_.block_columns];
      int column = -to_.margin;
      while (column < to_.columns + to_.margin) {
        // up to the next block of the image, or in the margin
        const int block_of = std::clamp(floor_div(column * s, BLOCK), 0, s_.block_columns - 1);
        int end = block_of + 1 == s_.block_columns ? to_.columns + to_.margin : (block_of + 1) * BLOCK / s;
        if (row >= 0 && row * s < job_.height && block_of + 2 < s_.block_columns)
          s_.fetch_block(row * s / BLOCK * s_.block_columns + block_of + 2, row * s % BLOCK, s);
        if (!near[block_of]) {
          std::fill(to_.row(0, row) + column, to_.row(0, row) + end, FARTHEST);
          std::fill(to_.row(1, row) + column, to_.row(1, row) + end, 1.0f);
          column = end;
        }
        while (column < end) {
          if (inside && column >= 0 && column < columns) {
            column += blocks(row, column, std::min(std::min(end, columns) - column, std::max(1, CELL / s)), pieces);
          } else {
            to_.row(0, row)[column] = NOWHERE;
            block(row, column++, false, pieces);
          }
        }
      }
      std::fill(to_.row(0, row) + column, to_.row(0, row) - to_.margin + to_.pitch, NOWHERE);
    }
    pieces.start.push_back((int)pieces.column.size());
  }

 private:
  // Values in place of a node: of empty blocks, and of blocks that no layer of this scale uses.
  static constexpr float NOWHERE = -2.0f, FARTHEST = 1e6f;

  // Computes up to `count` blocks in one cell (or one larger block) of a row; returns how many.
  int blocks(int row, int column, int count, Pieces &pieces) {
    const int s = to_.scale, y0 = row * s, x0 = column * s;
    const size_t cell = (size_t)(y0 / CELL) * index_.columns + x0 / CELL;
    const int k = s <= CELL && index_.single[cell] ? index_.only_interval(cell) : -1;
    if (k >= 0 && !to_.wanted[k]) {
      std::fill(to_.row(0, row) + column, to_.row(0, row) + column + count, (float)to_.stands_for[k]);
      std::fill(to_.row(1, row) + column, to_.row(1, row) + column + count, 1.0f);
      return count;
    }
    if (count * s == CELL && k >= 0)
      s == 2 ? cell_means<2>(row, column, k) : s == 4 ? cell_means<4>(row, column, k) : cell_means<8>(row, column, k);
    else if (count * s == std::max(s, CELL))
      s == 2   ? cell_sums<2>(row, column, pieces)
      : s == 4 ? cell_sums<4>(row, column, pieces)
      : s == 8 ? cell_sums<8>(row, column, pieces)
               : cell_sums<16>(row, column, pieces);
    else
      for (int i = 0; i < count; i++) block(row, column + i, true, pieces);
    return count;
  }

  // Block means of a cell whose pixels show one surface between the same two nodes.
  template <int S>
  void cell_means(int row, int column, int k) {
    constexpr int PARTS = CELL / LANES, COUNT = CELL / S;
    const int y0 = row * S, x0 = column * S;
    const size_t light_step = s_.has_block(y0 / BLOCK * s_.block_columns + x0 / BLOCK) ? BLOCK : s_.width;
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
    vec far[S][PARTS], sums[PARTS], sums_behind[PARTS] = {};
    for (int y = 0; y < S; y++)
      for (int p = 0; p < PARTS; p++)
        sums_behind[p] += far[y][p] = behind(job_.layers[k], index_.place(load<vec>(coc + y * s_.width + p * LANES)), over_);
    std::fill(to_.row(0, row) + column, to_.row(0, row) + column + COUNT, (float)to_.stands_for[k]);
    std::fill(to_.row(1, row) + column, to_.row(1, row) + column + COUNT, 1.0f);
    put(2, sums_behind);
    for (int c = 0; c < C_; c++) {
      for (int p = 0; p < PARTS; p++) sums[p] = sums_behind[p] = vec{};
      for (int y = 0; y < S; y++)
        for (int p = 0; p < PARTS; p++) {
          const vec v = load<vec>(light_[c] + y * light_step + p * LANES);
          sums[p] += v;
          sums_behind[p] += v * far[y][p];
        }
      put(3 + c, sums);
      put(3 + C_ + c, sums_behind);
    }
  }

  // Block means of a cell, one interval at a time, whole vectors of pixels.
  template <int S>
  void cell_sums(int row, int column, Pieces &pieces) {
    constexpr int WIDTH = S > CELL ? S : CELL, COUNT = WIDTH / S;
    typedef uint16_t halves __attribute__((vector_size(LANES * 2)));
    const int y0 = row * S, x0 = column * S;
    int there = 0;
    for (; there < s_.count; there++) {
      const float *coc, *weight;
      if (!s_.row(there, y0, x0, light_of_[there].data(), coc, weight)) break;
      const uint16_t *intervals = &index_.intervals[there][(size_t)y0 * s_.width + x0];
      for (int y = 0, i = 0; y < S; y++, coc += there ? BLOCK : s_.width, intervals += s_.width)
        for (int x = 0; x < WIDTH; x += LANES, i += LANES) {
          halves of_row;
          memcpy(&of_row, intervals + x, sizeof(of_row));
          store(interval_[there] + i, __builtin_convertvector(of_row, ivec));
          store(weight_[there] + i, weight ? load<vec>(weight + y * BLOCK + x) : all(1.0f));
          store(coc_[there] + i, load<vec>(coc + x));
        }
    }
    const bool continues = there == 2 && mixed(y0, x0) && continue_farther(S * WIDTH);
    const size_t light_step = s_.has_block(y0 / BLOCK * s_.block_columns + x0 / BLOCK) ? BLOCK : s_.width;
    cell_nodes_.clear();
    for (int i = 0; i < there; i++)
      continues ? sum_intervals<S, true>(i, light_step, before_[i], after_[i]) : sum_intervals<S, false>(i, light_step, weight_[i], weight_[i]);
    for (int i = 0; continues && i < (int)corrections_.size(); i++) {
      const NormalizerCorrection &of = corrections_[i];
      float *sums = &cell_sums_[cell_sums_of(to_.stands_for[of.node] | Pieces::NORMALIZER_ONLY, COUNT)] + of.pixel % WIDTH / S;
      sums[0] += of.up_to * each_;
      sums[(C_ + 1) * COUNT] += of.next * each_;
    }
    for (int j = 0; j < COUNT; j++) {
      float first = NOWHERE;
      const float *values_of_first = nullptr;
      for (size_t i = 0; i < cell_nodes_.size(); i++) {
        const float *values = &cell_sums_[i * stride_ * COUNT] + j;
        const bool normalizer_only = cell_nodes_[i] & Pieces::NORMALIZER_ONLY;
        if (*values == 0 && !(normalizer_only && values[(C_ + 1) * COUNT] != 0)) continue;
        if (values_of_first || normalizer_only)
          add_piece(pieces, column + j, cell_nodes_[i], values, COUNT, 1.0f);
        else
          first = (float)cell_nodes_[i], values_of_first = values;
      }
      put_in_planes(row, column + j, first, values_of_first, COUNT, 1.0f);
    }
  }

  // Sums the pixels of a surface. before, after: their weights in the layers before and after each pixel; equal unless
  // MIXED.
  template <int S, bool MIXED>
  void sum_intervals(int surface, size_t light_step, const float *before, const float *after) {
    constexpr int WIDTH = S > CELL ? S : CELL, PARTS = WIDTH / LANES, COUNT = WIDTH / S, DONE = -1;
    const int C = C_;
    vec place[S][PARTS], share[S][PARTS], part[S][PARTS];
    ivec interval[S][PARTS], last = ivec{} + DONE;
    for (int y = 0; y < S; y++)
      for (int p = 0; p < PARTS; p++) {
        const int i = y * WIDTH + p * LANES;
        place[y][p] = index_.place(load<vec>(coc_[surface] + i));
        interval[y][p] = load<vec>(weight_[surface] + i) != vec{} ? load<ivec>(interval_[surface] + i) : ivec{} + DONE;
        last = most(last, interval[y][p]);
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
            const vec far = behind(job_.layers[k], place[y][p], over_), second = MIXED ? its ? load<vec>(after + i) : vec{} : first;
            if (MIXED) share[y][p] += far * (second - first);
            sums_behind[p] += part[y][p] = far * second;
          }
          sums[p] += share[y][p];
          interval[y][p] = its ? ivec{} + DONE : interval[y][p];
          last = most(last, interval[y][p]);
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
    const size_t size = (size_t)stride_ * count, i = std::find(cell_nodes_.begin(), cell_nodes_.end(), node) - cell_nodes_.begin();
    if (i == cell_nodes_.size()) {
      cell_nodes_.push_back(node);
      cell_sums_.resize(std::max(cell_sums_.size(), (i + 1) * size));
      std::fill(&cell_sums_[i * size], &cell_sums_[i * size] + size, 0.0f);
    }
    return i * size;
  }

  // Stores values, `step` apart, times a factor: as a piece, or in the planes.
  void add_piece(Pieces &pieces, int column, int node, const float *values, int step, float factor) {
    pieces.column.push_back(column);
    pieces.node.push_back(node);
    for (int v = 0; v < stride_; v++) pieces.values.push_back(values[v * step] * factor);
  }
  void put_in_planes(int row, int column, float node, const float *values, int step, float factor) {
    to_.row(0, row)[column] = node;
    if (!values) return;
    const float *means = values, *means_behind = values + (C_ + 1) * step;
    to_.row(1, row)[column] = means[0] * factor;
    to_.row(2, row)[column] = means_behind[0] * factor;
    for (int c = 0; c < C_; c++) {
      to_.row(3 + c, row)[column] = means[(1 + c) * step] * factor;
      to_.row(3 + C_ + c, row)[column] = means_behind[(1 + c) * step] * factor;
    }
  }

  // One block, pixel by pixel. Its first contribution goes into the planes unless the block crosses the frame.
  void block(int row, int column, bool inside, Pieces &pieces) {
    gathered_.count = 0;
    gather(row, column);
    const float *values = gathered_.values.data();
    if (inside) put_in_planes(row, column, gathered_.count ? (float)gathered_.nodes[0] : NOWHERE, gathered_.count ? values : nullptr, 1, each_);
    for (int i = inside ? 1 : 0; i < gathered_.count; i++) add_piece(pieces, column, gathered_.nodes[i], values + (size_t)i * stride_, 1, each_);
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

  // Reads `count` pixels of a surface in a block, clamped to the frame. False if all weights are 0.
  bool read_beyond(int surface, int y0, int x0, int count, int columns) {
    const int H = job_.height, W = job_.width;
    float any = 0;
    for (int i = 0; i < count; i++) {
      const int y = std::clamp(y0 + i / columns, 0, H - 1), x = std::clamp(x0 + i % columns, 0, W - 1);
      const float *coc, *weight;
      const bool has_it = s_.row(surface, y, x, light_.data(), coc, weight);
      coc_[surface][i] = has_it ? *coc : 0.0f;
      any += weight_[surface][i] = !has_it ? 0.0f : weight ? *weight : 1.0f;
      interval_[surface][i] = index_.intervals[surface][(size_t)y * W + x];
    }
    for (int i = count; i % LANES; i++) coc_[surface][i] = weight_[surface][i] = 0.0f, interval_[surface][i] = 0;
    return any != 0;
  }

  // Position of pixels of a surface between their two nodes, 0 to 1.
  vec far_between(int surface, int i) const {
    vec at, per;
    for (int lane = 0; lane < LANES; lane++) {
      const Ramp &of = ramps_[interval_[surface][i + lane]];
      at[lane] = of.at, per[lane] = of.per;
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
      for (int surface = 0; surface < 2; surface++) store(before_[surface] + i, weight[surface]), store(after_[surface] + i, weight[surface]);
      if (!any_positive(extra)) continue;
      any = true;
      const vec fars[2] = {far_between(0, i), far_between(1, i)};
      const vec of_near = other_is_nearer ? fars[1] : fars[0], of_far = other_is_nearer ? fars[0] : fars[1];
      const ivec interval[2] = {load<ivec>(interval_[0] + i), load<ivec>(interval_[1] + i)};
      const ivec k = other_is_nearer ? interval[1] : interval[0], n = other_is_nearer ? interval[0] : interval[1];
      const vec next = share + visible_continuation(extra, of_near);  // in layer k + 1
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

  void gather(int row, int column) {
    const int s = to_.scale, y0 = row * s, x0 = column * s, H = job_.height, W = job_.width;
    // beside one edge of the frame coc and weight do not change away from it: one pixel represents a line of them
    const bool in_rows = y0 >= 0 && y0 + s <= H, in_columns = x0 >= 0 && x0 + s <= W;
    const bool above_or_below = in_columns && (y0 + s <= 0 || y0 >= H), beside = in_rows && (x0 + s <= 0 || x0 >= W);
    const int line = above_or_below || beside ? s : 1, count = s * s / line, columns = beside ? 1 : s;
    bool there[2] = {};
    for (int i = 0; i < s_.count; i++) {
      there[i] = read_beyond(i, y0, x0, count, columns);
      for (int j = 0; there[i] && j < count; j += LANES) store(far_[i] + j, far_between(i, j));
    }
    const bool continues = there[0] && there[1] && mixed(y0, x0) && continue_farther(count);
    for (int i = 0; i < s_.count; i++)
      if (there[i]) sum_pixels(i, y0, x0, count, columns, continues ? before_[i] : weight_[i], continues ? after_[i] : weight_[i]);
    // remove contributions of weight 0
    for (int i = 0; i < gathered_.count;) {
      if (gathered_.values[(size_t)i * stride_] != 0) {
        i++;
        continue;
      }
      gathered_.count--;
      gathered_.nodes[i] = gathered_.nodes[gathered_.count];
      memcpy(&gathered_.values[(size_t)i * stride_], &gathered_.values[(size_t)gathered_.count * stride_], stride_ * sizeof(float));
    }
    if (!continues) return;
    for (const NormalizerCorrection &of : corrections_) {
      float *values = gathered_.between(to_.stands_for[of.node] | Pieces::NORMALIZER_ONLY);
      values[0] += line * of.up_to;
      values[C_ + 1] += line * of.next;
    }
  }

  // Sums the pixels of a surface in a block; beside the frame each pixel represents a line of them.
  void sum_pixels(int i, int y0, int x0, int count, int columns, const float *before, const float *after) {
    const int H = job_.height, W = job_.width, C = C_, line = to_.scale * to_.scale / count;
    int last = -1;
    float *sums = nullptr;
    for (int j = 0; j < count; j++) {
      const float first = line * before[j], second = line * after[j];
      if (second == 0) continue;
      const int k = interval_[i][j];
      if (!to_.needed(k)) continue;
      if (k != last) {
        last = k;
        sums = gathered_.between(to_.stands_for[k]);
      }
      if (!to_.wanted[k]) {
        sums[0] += first;
        continue;
      }
      const int y = y0 + j / columns, x = x0 + j % columns, at_y = std::clamp(y, 0, H - 1), at_x = std::clamp(x, 0, W - 1);
      const float far = far_[i][j], part = far * second, w = first + far * (second - first);
      const float *coc, *weight;
      s_.row(i, at_y, at_x, light_.data(), coc, weight);
      float *sums_behind = sums + C + 1;
      sums[0] += w;
      sums_behind[0] += part;
      for (int c = 0; c < C; c++) {
        const float v = line > 1                   ? border_.mean_light(i, c, y, x, line, *light_[c])
                        : y != at_y || x != at_x ? border_.light(i, c, y, x, *light_[c])
                                                 : *light_[c];
        sums[1 + c] += v * w;
        sums_behind[1 + c] += v * part;
      }
    }
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
    int pixel, node;    // index in the block; node before the pixel's nearer surface
    float up_to, next;  // correction of the normalizer in the layers up to that node, and in the next one
  };
  // For a block's pixels and both surfaces. far: position between the nodes; before, after: weight in these layers.
  float coc_[2][BLOCK_PIXELS], weight_[2][BLOCK_PIXELS], far_[2][BLOCK_PIXELS], before_[2][BLOCK_PIXELS], after_[2][BLOCK_PIXELS];
  int32_t interval_[2][BLOCK_PIXELS];
  struct Ramp {
    float at, per;
  };
  std::vector<Ramp> ramps_;  // beyond each layer
  std::vector<NormalizerCorrection> corrections_;
  Gathered gathered_;
  std::vector<int> cell_nodes_;    // nodes in a row of blocks,
  std::vector<float> cell_sums_;  // and their values in the layout of pieces [nodes, stride, blocks]
  std::vector<const float *> light_, light_of_[2];
};

Downsampled::Downsampled(const Job &job, int scale, int margin)
    : scale(scale), margin(margin), rows(ceil_div(job.height, scale)), columns(ceil_div(job.width, scale)), channels(job.channels) {
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
        if (index.cell((size_t)row * index.columns + column)[w] & layers[w]) occupied[(size_t)(row / cells) * block_columns + column / cells] = 1;
  const int reach = ceil_div(2 * margin * scale, BLOCK);
  auto widen = [](const uint8_t *from, uint8_t *to, int count, int step, int reach) {
    for (int i = 0, last = -reach - 1; i < count + reach; i++) {  // last: latest occupied index up to i
      if (i < count && from[(size_t)i * step]) last = i;
      if (i >= reach) to[(size_t)(i - reach) * step] = last >= i - 2 * reach && last >= 0;
    }
  };
  near.resize(occupied.size());
  for (int row = 0; row < block_rows; row++) widen(&occupied[(size_t)row * block_columns], &near[(size_t)row * block_columns], block_columns, 1, reach);
  occupied.swap(near);
  for (int column = 0; column < block_columns; column++) widen(&occupied[column], &near[column], block_rows, block_columns, reach);
  job.parallel((int)pieces.size(), [&](int band, int) { Downsampling(job, index, border, *this).band(first_band + band); });
}

}  // namespace TORCHDOF_SIMD
}  // namespace torchdof
