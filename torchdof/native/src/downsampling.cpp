// Downsampling: means of the surfaces over blocks of pixels, once for all layers of a resolution. Pixels that lie between
// the same two nodes are added up together, with and without how far between them each lies: layers before and behind
// take their part of both.
#include "engine.h"

namespace torchdof {
namespace TORCHDOF_SIMD {
namespace {

typedef float f4 __attribute__((vector_size(16)));

// Adds up what a block of one surface has between two nodes; out as Pieces::values. Weights, in the layer before and in the
// one behind, lie without gaps.
template <int CHANNELS, int S>
void sum_part(const float *const *light, size_t light_step, const float *coc, size_t coc_step, const float *before,
              const float *after, const LayerIndex &index, const Layer &l, bool over, float *out) {
  f4 share = {}, part_sum = {}, one[CHANNELS] = {}, two[CHANNELS] = {};
  auto add = [&](const f4 first, const f4 second, const f4 c, auto light_at) {
    const f4 far = behind(l, index.place(c), over), part = far * second, w = first + far * (second - first);
    share += w;
    part_sum += part;
    for (int i = 0; i < CHANNELS; i++) {
      const f4 v = light_at(light[i]);
      one[i] += v * w;
      two[i] += v * part;
    }
  };
  if (S == 2) {
    auto four = [](const float *from, size_t step) { return f4{from[0], from[1], from[step], from[step + 1]}; };
    add(load<f4>(before), load<f4>(after), four(coc, coc_step), [&](const float *from) { return four(from, light_step); });
  } else {
    for (int y = 0; y < S; y++)
      for (int x = 0; x < S; x += 4)
        add(load<f4>(before + y * S + x), load<f4>(after + y * S + x), load<f4>(coc + y * coc_step + x),
            [&](const float *from) { return load<f4>(from + y * light_step + x); });
  }
  auto sum = [](f4 v) { return (v[0] + v[2]) + (v[1] + v[3]); };
  float *two_of = out + CHANNELS + 1;
  out[0] += sum(share);
  two_of[0] += sum(part_sum);
  for (int i = 0; i < CHANNELS; i++) {
    out[1 + i] += sum(one[i]);
    two_of[1 + i] += sum(two[i]);
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
        gathered_(stride_), cell_sums_(2 * stride_ * (CELL / 2)), light_(C_) {}

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
    const bool whole = count * s == CELL && !index_.mixed[cell];
    const bool summed = whole && (s == 2 ? cell_sums<2>(row, column, pieces) : s == 4 ? cell_sums<4>(row, column, pieces) : cell_sums<8>(row, column, pieces));
    for (int i = 0; i < count && !summed; i++) block(row, column + i, true, pieces);
    return count;
  }

  // Blocks in a row of a cell whose surfaces, not mixed, lie between two nodes each; false if they do not.
  template <int S>
  bool cell_sums(int row, int column, Pieces &pieces) {
    constexpr int PARTS = CELL / LANES, COUNT = CELL / S;
    const int C = C_, y0 = row * S, x0 = column * S;
    float *sums[2];  // of each surface, values as those of pieces, [stride, COUNT]
    int nodes[2] = {-1, -1};
    for (int i = 0; i < s_.count; i++) {
      const float *coc, *weight;
      if (!s_.row(i, y0, x0, light_.data(), coc, weight)) break;
      const uint16_t *intervals = &index_.intervals[i][(size_t)y0 * s_.width + x0], k = *intervals;
      unsigned differs = 0;
      for (int y = 0; y < S; y++)
        for (int x = 0; x < CELL; x++) differs |= intervals[(size_t)y * s_.width + x] ^ k;
      if (differs) return false;
      if (!to_.needed(k)) continue;
      nodes[i] = to_.stands_for[k];
      sums[i] = cell_sums_.data() + (size_t)i * stride_ * COUNT;
      auto put = [&](int value, const vec *sum) {  // sums of S neighbours
        float columns_of[CELL], *to = sums[i] + value * COUNT;
        for (int p = 0; p < PARTS; p++) store(columns_of + p * LANES, sum[p] * each_);
        for (int j = 0; j < COUNT; j++) {
          to[j] = 0;
          for (int x = 0; x < S; x++) to[j] += columns_of[j * S + x];
        }
      };
      const size_t light_step = weight ? BLOCK : s_.width, coc_step = i ? BLOCK : s_.width;
      vec whole[S][PARTS], far[S][PARTS], one[PARTS] = {}, two[PARTS] = {};
      for (int y = 0; y < S; y++)
        for (int p = 0; p < PARTS; p++) {
          const vec place = index_.place(load<vec>(coc + y * coc_step + p * LANES));
          one[p] += whole[y][p] = weight ? load<vec>(weight + y * BLOCK + p * LANES) : all(1.0f);
          two[p] += far[y][p] = to_.wanted[k] ? whole[y][p] * behind(job_.layers[k], place, over_) : vec{};
        }
      put(0, one);
      put(C + 1, two);
      for (int c = 0; c < C; c++) {
        for (int p = 0; p < PARTS; p++) one[p] = two[p] = vec{};
        for (int y = 0; y < S && to_.wanted[k]; y++)
          for (int p = 0; p < PARTS; p++) {
            const vec v = load<vec>(light_[c] + y * light_step + p * LANES);
            one[p] += v * whole[y][p];
            two[p] += v * far[y][p];
          }
        put(1 + c, one);
        put(C + 2 + c, two);
      }
    }
    for (int j = 0; j < COUNT; j++) {
      int first = -1;
      for (int i = 0; i < 2; i++) {
        if (nodes[i] < 0 || sums[i][j] == 0) continue;
        if (first < 0)
          first = i;
        else if (nodes[i] == nodes[first])
          for (int v = 0; v < stride_; v++) sums[first][v * COUNT + j] += sums[i][v * COUNT + j];
        else
          add_piece(pieces, column + j, nodes[i], sums[i] + j, COUNT, 1.0f);
      }
      put_in_planes(row, column + j, first < 0 ? NOWHERE : (float)nodes[first], first < 0 ? nullptr : sums[first] + j, COUNT, 1.0f);
    }
    return true;
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

  // Weights of both surfaces of a block's pixels, in the layer before each and in the one behind it. The farther one of a
  // mixed pixel goes on behind the nearer: there it counts for more than its share, and what it thereby has too much of in
  // the layers up to the nearer one is to be taken from their room. False if there is no such pixel.
  bool share_out(int y0, int x0, bool inside) {
    lacking_.clear();
    const int s = to_.scale, run = inside ? std::min(s, 4) : 1;
    bool any = false;
    for (int i = 0; i < s * s; i += 4) {
      f4 coc[2], weight[2];
      int interval[2][4];
      for (int lane = 0; lane < 4; lane += run) {
        const int y = std::clamp(y0 + (i + lane) / s, 0, job_.height - 1), x = std::clamp(x0 + (i + lane) % s, 0, job_.width - 1);
        for (int j = 0; j < 2; j++) {
          const float *coc_of, *weight_of;
          s_.row(j, y, x, light_.data(), coc_of, weight_of);
          for (int k = 0; k < run; k++) {
            coc[j][lane + k] = coc_of[k];
            weight[j][lane + k] = weight_of[k];
            interval[j][lane + k] = index_.intervals[j][(size_t)y * job_.width + x + k];
          }
        }
      }
      const auto other_is_nearer = coc[1] < coc[0];
      const f4 share = other_is_nearer ? weight[0] : weight[1], going = going_on(share), whole = share + going;
      f4 first = share, second = share;
      for (int lane = 0, last = -1; lane < 4; lane++) {
        if (!(going[lane] > 0)) continue;
        any = true;
        const int near = other_is_nearer[lane] ? 1 : 0, k = interval[near][lane], n = interval[1 - near][lane];
        if (!to_.needed(n) && !to_.needed(k)) continue;
        const float of_near = behind(job_.layers[k], index_.place(coc[near][lane]), over_);
        const float next = share[lane] + where_it_shows(going[lane], of_near);  // in layer k + 1
        first[lane] = n == k ? share[lane] : n == k + 1 ? next : whole[lane];
        second[lane] = n == k ? next : whole[lane];
        if (!to_.needed(k)) continue;
        const float of_far = to_.wanted[n] ? behind(job_.layers[n], index_.place(coc[1 - near][lane]), over_) : 0.0f;
        const float given = first[lane] + of_far * (second[lane] - first[lane]);
        if (k != last) lacking_.push_back({last = k, 0.0f, 0.0f});
        lacking_.back().up_to += share[lane] - given;
        if (to_.wanted[k] && n > k) lacking_.back().next += next - given;
      }
      store(before_[0] + i, other_is_nearer ? first : weight[0]);
      store(after_[0] + i, other_is_nearer ? second : weight[0]);
      store(before_[1] + i, other_is_nearer ? weight[1] : first);
      store(after_[1] + i, other_is_nearer ? weight[1] : second);
    }
    return any;
  }

  void gather(int row, int column, bool inside) {
    const int s = to_.scale, y0 = row * s, x0 = column * s, H = job_.height, W = job_.width, C = C_;
    const float *coc, *weight;
    const bool two = s_.count == 2 && mixed(y0, x0) && share_out(y0, x0, inside);
    for (int i = 0; i < s_.count; i++) {
      if (inside) {
        if (!s_.row(i, y0, x0, light_.data(), coc, weight)) break;
        if (C == 3) {
          const uint16_t *interval = &index_.intervals[i][(size_t)y0 * W + x0];
          const int coc_step = i ? BLOCK : W;
          const float *before = two ? before_[i] : weight, *after = two ? after_[i] : weight;
          const int pitch = two ? s : BLOCK;
          s == 2 ? sum_intervals<2>(interval, coc, coc_step, weight, before, after, pitch)
          : s == 4 ? sum_intervals<4>(interval, coc, coc_step, weight, before, after, pitch)
          : s == 8 ? sum_intervals<8>(interval, coc, coc_step, weight, before, after, pitch)
                   : sum_intervals<16>(interval, coc, coc_step, weight, before, after, pitch);
          continue;
        }
      }
      int last = -1;
      float *one = nullptr;
      for (int y = 0; y < s; y++) {
        const int at_y = std::clamp(y0 + y, 0, H - 1);
        if (inside) s_.row(i, at_y, x0, light_.data(), coc, weight);
        for (int x = 0; x < s; x++) {
          int at = x, at_x = x0 + x;
          bool beyond = false;
          if (!inside) {
            at_x = std::clamp(at_x, 0, W - 1);
            beyond = y0 + y != at_y || x0 + x != at_x;
            at = 0;
            if (!s_.row(i, at_y, at_x, light_.data(), coc, weight)) continue;
          }
          const float first = two ? before_[i][y * s + x] : weight ? weight[at] : 1.0f, second = two ? after_[i][y * s + x] : first;
          if (second == 0) continue;
          const int k = index_.intervals[i][(size_t)at_y * W + at_x];
          if (!to_.needed(k)) continue;
          if (k != last) {
            last = k;
            one = gathered_.between(to_.stands_for[k]);
          }
          if (!to_.wanted[k]) {
            one[0] += first;
            continue;
          }
          const Layer &l = job_.layers[k];
          const float far = behind(l, index_.place(coc[at]), over_), part = far * second, w = first + far * (second - first);
          float *parts = one + C + 1;
          one[0] += w;
          parts[0] += part;
          for (int c = 0; c < C; c++) {
            const float v = beyond ? border_.light(i, c, y0 + y, x0 + x, light_[c][at]) : light_[c][at];
            one[1 + c] += v * w;
            parts[1 + c] += v * part;
          }
        }
      }
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
      values[0] += of.up_to;
      values[C + 1] += of.next;
    }
  }

  // A block of one surface, of three channels, within the frame: the sums of each interval that occurs in it.
  template <int S>
  void sum_intervals(const uint16_t *interval, const float *coc, int coc_step, const float *weight, const float *before,
                     const float *after, int pitch) {
    constexpr int AREA = S * S;
    const size_t light_step = weight ? BLOCK : s_.width;
    float left[AREA], left_after[AREA], interval_of[AREA], of_one[AREA], of_one_after[AREA];
    unsigned differs = 0;
    float any = 0;
    for (int y = 0; y < S; y++)
      for (int x = 0; x < S; x++) {
        differs |= interval[(size_t)y * s_.width + x] ^ *interval;
        left[y * S + x] = weight ? before[y * pitch + x] : 1.0f;
        left_after[y * S + x] = weight ? after[y * pitch + x] : 1.0f;
        any += left[y * S + x];
      }
    if (any == 0) return;
    auto add = [&](int node, const float *firsts, const float *seconds, float sum) {
      if (to_.wanted[node])
        sum_part<3, S>(light_.data(), light_step, coc, coc_step, firsts, seconds, index_, job_.layers[node], over_, gathered_.between(to_.stands_for[node]));
      else if (to_.needed(node))
        gathered_.between(to_.stands_for[node])[0] += sum;
    };
    if (!differs) return add(*interval, left, left_after, any);
    for (int y = 0; y < S; y++)
      for (int x = 0; x < S; x++) interval_of[y * S + x] = (float)interval[(size_t)y * s_.width + x];
    for (int i = 0; i < AREA; i++) {
      if (left[i] == 0) continue;
      const float k = interval_of[i];
      any = 0;
      for (int j = 0; j < AREA; j++) {  // the others weigh nothing
        of_one[j] = interval_of[j] == k ? left[j] : 0.0f;
        of_one_after[j] = interval_of[j] == k ? left_after[j] : 0.0f;
        left[j] -= of_one[j];
        any += of_one[j];
      }
      add((int)k, of_one, of_one_after, any);
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
  float before_[2][BLOCK_PIXELS], after_[2][BLOCK_PIXELS];
  std::vector<Lacking> lacking_;
  Gathered gathered_;
  std::vector<float> cell_sums_;
  std::vector<const float *> light_;
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
