// Downsampling: means of the surfaces over blocks of pixels, once for all layers of a resolution. Pixels that lie between
// the same two nodes are added up together, with and without how far between them each lies: layers before and behind
// take their part of both.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

typedef float f4 __attribute__((vector_size(16)));
typedef int32_t i4 __attribute__((vector_size(16)));

// Four pixels of a block of S x S, the i-th of them the first.
template <int S>
inline f4 four(const float *from, size_t step, int i) {
  if (S == 2) return f4{from[0], from[1], from[step], from[step + 1]};
  return load<f4>(from + i / S * step + i % S);
}

// Adds up what a block of one surface, of three channels, has between two nodes; out as Pieces::values. Weights, in the layer
// before and in the one behind, lie without gaps, and so does how far between the nodes each pixel lies.
template <int S>
void sum_part(const float *const *light, size_t light_step, const float *before, const float *after, const float *far, float *out) {
  constexpr int CHANNELS = 3;
  f4 share = {}, part_sum = {}, one[CHANNELS] = {}, two[CHANNELS] = {};
  for (int i = 0; i < S * S; i += 4) {
    const f4 first = load<f4>(before + i), second = load<f4>(after + i), its_far = load<f4>(far + i);
    const f4 part = its_far * second, w = first + its_far * (second - first);
    share += w;
    part_sum += part;
    for (int c = 0; c < CHANNELS; c++) {
      const f4 v = four<S>(light[c], light_step, i);
      one[c] += v * w;
      two[c] += v * part;
    }
  }
  auto sum = [](f4 v) { return (v[0] + v[2]) + (v[1] + v[3]); };
  float *two_of = out + CHANNELS + 1;
  out[0] += sum(share);
  two_of[0] += sum(part_sum);
  for (int c = 0; c < CHANNELS; c++) {
    out[1 + c] += sum(one[c]);
    two_of[1 + c] += sum(two[c]);
  }
}

// Of a block of pixels: what lies between each two nodes.
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

  // Rows of blocks of BLOCK pixels.
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
        // as far as the next block of the image, or around the frame
        const int block_of = std::clamp(floor_div(column * s, BLOCK), 0, s_.block_columns - 1);
        int end = block_of + 1 == s_.block_columns ? to_.columns + to_.margin : (block_of + 1) * BLOCK / s;
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
  static constexpr float NOWHERE = -2.0f, FARTHEST = 1e6f;  // nodes of blocks that hold nothing, and of what is of no account

  // Blocks of one row within a cell, or one that is larger; returns how many.
  int blocks(int row, int column, int count, Pieces &pieces) {
    const int s = to_.scale, y0 = row * s, x0 = column * s;
    const size_t cell = (size_t)(y0 / CELL) * index_.columns + x0 / CELL;
    const int k = s <= CELL && index_.single[cell] ? index_.only_interval(cell) : -1;
    if (k >= 0 && !to_.wanted[k]) {
      std::fill(to_.row(0, row) + column, to_.row(0, row) + column + count, (float)to_.stands_for[k]);
      std::fill(to_.row(1, row) + column, to_.row(1, row) + column + count, 1.0f);
      return count;
    }
    if (count * s == CELL && !index_.mixed[cell])
      s == 2 ? cell_sums<2>(row, column, pieces) : s == 4 ? cell_sums<4>(row, column, pieces) : cell_sums<8>(row, column, pieces);
    else
      for (int i = 0; i < count; i++) block(row, column + i, true, pieces);
    return count;
  }

  // Blocks in a row of a cell whose surfaces are not mixed: interval by interval, a row of the cell at once.
  template <int S>
  void cell_sums(int row, int column, Pieces &pieces) {
    constexpr int PARTS = CELL / LANES, COUNT = CELL / S, DONE = -1;
    typedef uint16_t halves __attribute__((vector_size(LANES * 2)));
    const int C = C_, y0 = row * S, x0 = column * S;
    cell_nodes_.clear();
    for (int i = 0; i < s_.count; i++) {
      const float *coc, *weight;
      if (!s_.row(i, y0, x0, light_.data(), coc, weight)) break;
      const uint16_t *intervals = &index_.intervals[i][(size_t)y0 * s_.width + x0];
      const size_t light_step = weight ? BLOCK : s_.width, coc_step = i ? BLOCK : s_.width;
      vec weighs[S][PARTS], place[S][PARTS], whole[S][PARTS], far[S][PARTS];
      ivec interval[S][PARTS];
      for (int y = 0; y < S; y++)
        for (int p = 0; p < PARTS; p++) {
          halves of_row;
          memcpy(&of_row, intervals + (size_t)y * s_.width + p * LANES, sizeof(of_row));
          interval[y][p] = __builtin_convertvector(of_row, ivec);
          weighs[y][p] = weight ? load<vec>(weight + y * BLOCK + p * LANES) : all(1.0f);
          place[y][p] = index_.place(load<vec>(coc + y * coc_step + p * LANES));
        }
      for (int k = *intervals; k != DONE;) {
        vec one[PARTS] = {}, two[PARTS] = {};
        ivec left = ivec{} + DONE;  // intervals still to come
        for (int y = 0; y < S; y++)
          for (int p = 0; p < PARTS; p++) {
            const auto its = interval[y][p] == k;
            one[p] += whole[y][p] = its ? weighs[y][p] : vec{};
            interval[y][p] = its ? ivec{} + DONE : interval[y][p];
            left = most(left, interval[y][p]);
          }
        if (to_.needed(k)) {
          const size_t sums = cell_sums_of(to_.stands_for[k], COUNT);
          auto put = [&](int value, const vec *sum) {  // sums of S neighbours
            float columns_of[CELL], *to = cell_sums_.data() + sums + value * COUNT;
            for (int p = 0; p < PARTS; p++) store(columns_of + p * LANES, sum[p] * each_);
            for (int x = 0; x < CELL; x++) to[x / S] += columns_of[x];
          };
          put(0, one);
          for (int y = 0; y < S && to_.wanted[k]; y++)
            for (int p = 0; p < PARTS; p++) two[p] += far[y][p] = whole[y][p] * behind(job_.layers[k], place[y][p], over_);
          put(C + 1, two);
          for (int c = 0; c < C && to_.wanted[k]; c++) {
            for (int p = 0; p < PARTS; p++) one[p] = two[p] = vec{};
            for (int y = 0; y < S; y++)
              for (int p = 0; p < PARTS; p++) {
                const vec v = load<vec>(light_[c] + y * light_step + p * LANES);
                one[p] += v * whole[y][p];
                two[p] += v * far[y][p];
              }
            put(1 + c, one);
            put(C + 2 + c, two);
          }
        }
        k = DONE;
        for (int lane = 0; lane < LANES; lane++) k = std::max(k, (int)left[lane]);
      }
    }
    for (int j = 0; j < COUNT; j++) {
      float first = NOWHERE;
      const float *values_of_first = nullptr;
      for (size_t i = 0; i < cell_nodes_.size(); i++) {
        const float *values = &cell_sums_[i * stride_ * COUNT] + j;
        if (*values == 0) continue;
        if (values_of_first)
          add_piece(pieces, column + j, cell_nodes_[i], values, COUNT, 1.0f);
        else
          first = (float)cell_nodes_[i], values_of_first = values;
      }
      put_in_planes(row, column + j, first, values_of_first, COUNT, 1.0f);
    }
  }
  // Where the sums of a node begin, [stride, count].
  size_t cell_sums_of(int node, int count) {
    const size_t size = (size_t)stride_ * count, i = std::find(cell_nodes_.begin(), cell_nodes_.end(), node) - cell_nodes_.begin();
    if (i == cell_nodes_.size()) {
      cell_nodes_.push_back(node);
      cell_sums_.resize(std::max(cell_sums_.size(), (i + 1) * size));
      std::fill(&cell_sums_[i * size], &cell_sums_[i * size] + size, 0.0f);
    }
    return i * size;
  }

  // Values of a piece, so far apart, times a factor: among the pieces, or in the planes.
  void add_piece(Pieces &pieces, int column, int node, const float *values, int step, float factor) {
    pieces.column.push_back(column);
    pieces.node.push_back(node);
    for (int v = 0; v < stride_; v++) pieces.values.push_back(values[v * step] * factor);
  }
  void put_in_planes(int row, int column, float node, const float *values, int step, float factor) {
    to_.row(0, row)[column] = node;
    if (!values) return;
    const float *one = values, *two = values + (C_ + 1) * step;
    to_.row(1, row)[column] = one[0] * factor;
    to_.row(2, row)[column] = two[0] * factor;
    for (int c = 0; c < C_; c++) {
      to_.row(3 + c, row)[column] = one[(1 + c) * step] * factor;
      to_.row(3 + C_ + c, row)[column] = two[(1 + c) * step] * factor;
    }
  }

  // Any block. The first of what it holds stands in the planes, unless part of the block lies beyond the frame.
  void block(int row, int column, bool inside, Pieces &pieces) {
    gathered_.count = 0;
    gather(row, column, inside);
    const float *values = gathered_.values.data();
    if (inside) put_in_planes(row, column, gathered_.count ? (float)gathered_.nodes[0] : NOWHERE, gathered_.count ? values : nullptr, 1, each_);
    for (int i = inside ? 1 : 0; i < gathered_.count; i++) add_piece(pieces, column, gathered_.nodes[i], values + (size_t)i * stride_, 1, each_);
  }

  // Whether a block, continued beyond the frame, lies in cells with mixed pixels.
  bool mixed(int y0, int x0) const {
    auto cell = [&](int at, int size) { return std::clamp(at, 0, size - 1) / CELL; };
    const int H = job_.height, W = job_.width, end = to_.scale - 1;
    for (int row = cell(y0, H); row <= cell(y0 + end, H); row++)
      for (int column = cell(x0, W); column <= cell(x0 + end, W); column++)
        if (index_.mixed[(size_t)row * index_.columns + column]) return true;
    return false;
  }

  // Pixels of a surface in a block within the frame; false if it has no weight there.
  template <int S>
  bool read(int surface, int y0, int x0) {
    const int W = job_.width;
    const float *coc, *weight;
    if (!s_.row(surface, y0, x0, light_of_[surface].data(), coc, weight)) return false;
    const uint16_t *interval = &index_.intervals[surface][(size_t)y0 * W + x0];
    float any = 0;
    for (int y = 0; y < S; y++)
      for (int x = 0; x < S; x++) {
        any += weight_[surface][y * S + x] = weight ? weight[y * BLOCK + x] : 1.0f;
        interval_[surface][y * S + x] = interval[(size_t)y * W + x];
      }
    for (int i = 0; i < S * S; i += 4) store(coc_[surface] + i, four<S>(coc, surface ? BLOCK : W, i));
    return any != 0;
  }
  // The same of a block that the frame cuts off, where it goes on with its last pixels: so many, row by row.
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
    for (int i = count; i % 4; i++) coc_[surface][i] = weight_[surface][i] = 0.0f, interval_[surface][i] = 0;
    return any != 0;
  }

  // How far between its two nodes each pixel of a surface lies.
  void find_far(int surface, int count) {
    for (int i = 0; i < count; i += 4) {
      const int32_t *k = interval_[surface] + i;
      const Ramp of[4] = {ramps_[k[0]], ramps_[k[1]], ramps_[k[2]], ramps_[k[3]]};
      const f4 at = {of[0].at, of[1].at, of[2].at, of[3].at}, per = {of[0].per, of[1].per, of[2].per, of[3].per};
      store(far_[surface] + i, ramp((index_.place(load<f4>(coc_[surface] + i)) - at) * per, over_));
    }
  }

  // Weights of both surfaces of a block's pixels, in the layer before each and in the one behind it. The farther one of a
  // mixed pixel goes on behind the nearer: there it counts for more than its share, and what it thereby has too much of in
  // the layers up to the nearer one is to be taken from their room. False if there is no such pixel.
  bool share_out(int count) {
    lacking_.clear();
    bool any = false;
    for (int i = 0, last = -1; i < count; i += 4) {
      const f4 weight[2] = {load<f4>(weight_[0] + i), load<f4>(weight_[1] + i)};
      const auto other_is_nearer = load<f4>(coc_[1] + i) < load<f4>(coc_[0] + i);
      const f4 share = other_is_nearer ? weight[0] : weight[1], going = going_on(share), whole = share + going;
      const f4 far[2] = {load<f4>(far_[0] + i), load<f4>(far_[1] + i)}, of_near = other_is_nearer ? far[1] : far[0];
      const i4 interval[2] = {load<i4>(interval_[0] + i), load<i4>(interval_[1] + i)};
      const i4 k = other_is_nearer ? interval[1] : interval[0], n = other_is_nearer ? interval[0] : interval[1];
      const f4 next = share + where_it_shows(going, of_near);  // in layer k + 1
      const f4 first = n == k ? share : n == k + 1 ? next : whole, second = n == k ? next : whole;
      store(before_[0] + i, other_is_nearer ? first : weight[0]);
      store(after_[0] + i, other_is_nearer ? second : weight[0]);
      store(before_[1] + i, other_is_nearer ? weight[1] : first);
      store(after_[1] + i, other_is_nearer ? weight[1] : second);
      for (int lane = 0; lane < 4; lane++) {
        if (!(going[lane] > 0)) continue;
        any = true;
        const int nearer = k[lane], farther = n[lane];
        if (!to_.needed(nearer)) continue;
        const float of_far = to_.wanted[farther] ? far[other_is_nearer[lane] ? 0 : 1][lane] : 0.0f;
        const float given = first[lane] + of_far * (second[lane] - first[lane]);
        if (nearer != last) lacking_.push_back({last = nearer, 0.0f, 0.0f});
        lacking_.back().up_to += share[lane] - given;
        if (to_.wanted[nearer] && farther > nearer) lacking_.back().next += next[lane] - given;
      }
    }
    return any;
  }

  void gather(int row, int column, bool inside) {
    const int s = to_.scale, y0 = row * s, x0 = column * s, H = job_.height, W = job_.width;
    // away from one side of the frame all is alike but the light: there a pixel stands for a line of them
    const bool in_rows = y0 >= 0 && y0 + s <= H, in_columns = x0 >= 0 && x0 + s <= W;
    const bool above_or_below = in_columns && (y0 + s <= 0 || y0 >= H), beside = in_rows && (x0 + s <= 0 || x0 >= W);
    const int line = above_or_below || beside ? s : 1, count = s * s / line, columns = beside ? 1 : s;
    bool there[2] = {};
    for (int i = 0; i < s_.count; i++) {
      there[i] = !inside ? read_beyond(i, y0, x0, count, columns) : s == 2 ? read<2>(i, y0, x0) : s == 4 ? read<4>(i, y0, x0) : s == 8 ? read<8>(i, y0, x0) : read<16>(i, y0, x0);
      if (there[i]) find_far(i, count);
    }
    const bool two = there[0] && there[1] && mixed(y0, x0) && share_out(count);
    for (int i = 0; i < s_.count; i++) {
      if (!there[i]) continue;
      const float *before = two ? before_[i] : weight_[i], *after = two ? after_[i] : weight_[i];
      if (inside && C_ == 3) {
        const size_t light_step = s_.has_block(y0 / BLOCK * s_.block_columns + x0 / BLOCK) ? BLOCK : W;
        s == 2 ? sum_intervals<2>(i, light_step, before, after) : s == 4 ? sum_intervals<4>(i, light_step, before, after)
        : s == 8 ? sum_intervals<8>(i, light_step, before, after) : sum_intervals<16>(i, light_step, before, after);
        continue;
      }
      sum_pixels(i, y0, x0, count, columns, before, after);
    }
    // nothing is left of what weighs nothing
    for (int i = 0; i < gathered_.count;) {
      if (gathered_.values[(size_t)i * stride_] != 0) {
        i++;
        continue;
      }
      gathered_.count--;
      gathered_.nodes[i] = gathered_.nodes[gathered_.count];
      memcpy(&gathered_.values[(size_t)i * stride_], &gathered_.values[(size_t)gathered_.count * stride_], stride_ * sizeof(float));
    }
    if (!two) return;
    for (const Lacking &of : lacking_) {
      float *values = gathered_.between(to_.stands_for[of.node] | Pieces::ROOM_ONLY);
      values[0] += line * of.up_to;
      values[C_ + 1] += line * of.next;
    }
  }

  // Pixels of a block of one surface, one by one; where there are fewer than a block has, each stands for a line away from the
  // frame.
  void sum_pixels(int i, int y0, int x0, int count, int columns, const float *before, const float *after) {
    const int H = job_.height, W = job_.width, C = C_, line = to_.scale * to_.scale / count;
    int last = -1;
    float *one = nullptr;
    for (int j = 0; j < count; j++) {
      const float first = line * before[j], second = line * after[j];
      if (second == 0) continue;
      const int k = interval_[i][j];
      if (!to_.needed(k)) continue;
      if (k != last) {
        last = k;
        one = gathered_.between(to_.stands_for[k]);
      }
      if (!to_.wanted[k]) {
        one[0] += first;
        continue;
      }
      const int y = y0 + j / columns, x = x0 + j % columns, at_y = std::clamp(y, 0, H - 1), at_x = std::clamp(x, 0, W - 1);
      const float far = far_[i][j], part = far * second, w = first + far * (second - first);
      const float *coc, *weight;
      s_.row(i, at_y, at_x, light_.data(), coc, weight);
      float *parts = one + C + 1;
      one[0] += w;
      parts[0] += part;
      for (int c = 0; c < C; c++) {
        const float v = line > 1                   ? border_.mean_light(i, c, y, x, line, *light_[c])
                        : y != at_y || x != at_x ? border_.light(i, c, y, x, *light_[c])
                                                 : *light_[c];
        one[1 + c] += v * w;
        parts[1 + c] += v * part;
      }
    }
  }

  // A block of one surface, of three channels, within the frame: the sums of each interval that occurs in it.
  template <int S>
  void sum_intervals(int surface, size_t light_step, const float *before, const float *after) {
    constexpr int AREA = S * S;
    const int32_t *const interval = interval_[surface];
    int differs = 0;
    for (int i = 0; i < AREA; i++) differs |= interval[i] ^ *interval;
    auto add = [&](int node, const float *firsts, const float *seconds) {
      if (to_.wanted[node]) {
        sum_part<S>(light_of_[surface].data(), light_step, firsts, seconds, far_[surface], gathered_.between(to_.stands_for[node]));
      } else if (to_.needed(node)) {
        float sum = 0;
        for (int i = 0; i < AREA; i++) sum += firsts[i];
        gathered_.between(to_.stands_for[node])[0] += sum;
      }
    };
    if (!differs) return add(*interval, before, after);
    float left[AREA], of_one[AREA], of_one_after[AREA];
    memcpy(left, before, sizeof(left));
    for (int i = 0; i < AREA; i++) {
      if (left[i] == 0) continue;
      const int k = interval[i];
      for (int j = 0; j < AREA; j++) {  // the others weigh nothing
        of_one[j] = interval[j] == k ? left[j] : 0.0f;
        of_one_after[j] = interval[j] == k ? after[j] : 0.0f;
        left[j] -= of_one[j];
      }
      add(k, of_one, of_one_after);
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
  struct Lacking {
    int node;           // before a nearer surface
    float up_to, next;  // room that is to be added in the layers up to it, and in the next one
  };
  // of a block's pixels, of both surfaces; far: how far between their nodes; before, after: weight in the layers there
  float coc_[2][BLOCK_PIXELS], weight_[2][BLOCK_PIXELS], far_[2][BLOCK_PIXELS], before_[2][BLOCK_PIXELS], after_[2][BLOCK_PIXELS];
  int32_t interval_[2][BLOCK_PIXELS];
  struct Ramp {
    float at, per;
  };
  std::vector<Ramp> ramps_;  // beyond each layer
  std::vector<Lacking> lacking_;
  Gathered gathered_;
  std::vector<int> cell_nodes_;    // in a row of blocks of a cell,
  std::vector<float> cell_sums_;  // and values as those of pieces, [nodes, stride, blocks]
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
  // what is neither spread by a layer of this resolution nor seen behind one is left out
  const int layers = (int)job.layers.size();
  wanted.resize(layers), behind.resize(layers), stands_for.resize(layers);
  for (int k = 0, class_of = 0; k < layers; k++) {
    const bool here = job.layers[k].scale == scale, next = k + 1 < layers && job.layers[k + 1].scale == scale;
    wanted[k] = here || next;
    behind[k] = here || (k && behind[k - 1]);
    if (wanted[k] || (k && wanted[k - 1])) class_of = k;  // those between two runs lie behind the same layers
    stands_for[k] = (uint16_t)class_of;
  }
  if (!job.scene.occlusion) behind = wanted;
}

void Downsampled::take(const Job &job, const LayerIndex &index, const Border &border) {
  // blocks of pixels that a layer of this resolution occupies; as far as its light reaches, and as far again for what
  // lies behind there
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
    for (int i = 0, last = -reach - 1; i < count + reach; i++) {  // last: of those occupied up to i
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
