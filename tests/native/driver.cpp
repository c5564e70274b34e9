// Renders random scenes, repairs the edges of their depth, and computes the steps of a rendering that have a gradient,
// through the C interface, for the sanitizers: `make sanitize`.
//
// Each scene is rendered by one thread first. Then several callers at once, each with threads of its own, must get the
// same bits, and a cancelled call must return. The tests in Python check the pictures themselves.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <limits>
#include <memory>
#include <random>
#include <thread>
#include <vector>

#include "api.h"
#include "constants/native.h"

namespace {

[[noreturn]] void fail(const char *claim, int scene) {
  std::fprintf(stderr, "driver: scene %d: %s\n", scene, claim);
  std::exit(1);
}

// A disc of a radius in pixels, with a soft rim, once for each colour; it sums to 1.
std::vector<float> disc(double radius, int half, int colours) {
  const int size = 2 * half + 1;
  std::vector<float> kernel;
  for (int y = -half; y <= half; y++)
    for (int x = -half; x <= half; x++) kernel.push_back(float(std::clamp(radius + 0.5 - std::hypot(x, y), 0.0, 1.0)));
  kernel[half * size + half] += 1e-3f;
  double sum = 0;
  for (float value : kernel) sum += value;
  for (float &value : kernel) value = float(value / sum);
  std::vector<float> repeated;
  for (int c = 0; c < colours; c++) repeated.insert(repeated.end(), kernel.begin(), kernel.end());
  return repeated;
}

// Field masks of some radii: the transmittance falls along the kernel, and more so farther from the middle.
struct Field {
  static constexpr int distances = 5, columns = 4, rows = 2 * columns - 1;
  std::vector<std::vector<float>> values, boxes;
  std::vector<torchdof_field_mask> masks;

  Field(const std::vector<double> &radii, int colours) {
    for (double radius : radii) {
      std::vector<float> through, box;
      for (int c = 0; c < colours; c++)
        for (int d = 0; d < distances; d++)
          for (int i = 0; i < rows * columns; i++)
            through.push_back(float(std::clamp(2.0 - d * (i / columns) / double(distances + c), 0.0, 1.0)));
      for (int d = 0; d < distances; d++)
        for (double side : {-0.1 * d, std::abs(radius) + 1.0, std::abs(radius) + 1.0}) box.push_back(float(side));
      values.push_back(through);
      boxes.push_back(box);
    }
    for (size_t i = 0; i < radii.size(); i++)
      masks.push_back({values[i].data(), boxes[i].data(), float(radii[i]), colours, rows, columns});
  }
};

// A scene and the memory that it points to.
struct Scene {
  torchdof_scene scene{};
  std::vector<std::vector<float>> light, coc, weight;
  std::vector<const float *> light_at, coc_at, weight_at;
  std::vector<double> nodes;
  std::vector<int32_t> scales, halves;
  std::vector<float> kernels;
  std::unique_ptr<Field> field;

  explicit Scene(unsigned seed) {
    std::mt19937 random(seed);
    const auto integer = [&](int low, int high) { return std::uniform_int_distribution<int>(low, high)(random); };
    const auto number = [&](double low, double high) { return std::uniform_real_distribution<>(low, high)(random); };
    scene.height = integer(1, 4) == 1 ? integer(1, 7) : integer(8, 200);
    scene.width = integer(1, 4) == 1 ? integer(1, 7) : integer(8, 300);
    scene.channels = integer(1, 5);
    scene.kind = integer(TORCHDOF_IMAGE, TORCHDOF_STACK);
    scene.surfaces = scene.kind == TORCHDOF_IMAGE ? 1 : scene.kind == TORCHDOF_BACKGROUND ? 2 : integer(1, 4);
    scene.occlusion = integer(0, 3) > 0;
    scene.normalize = integer(0, 3) > 0;
    scene.masked = integer(0, 1) && scene.kind != TORCHDOF_STACK;  // a stack's values are finite
    scene.highlights = integer(0, 3) > 0;
    scene.crisp_px = float(number(0.5, 4.0));
    scene.reach = float(number(1.0, 3.0));
    scene.squeeze = 1.0f;
    const double largest = number(1.0, 40.0);
    surfaces(integer, number, largest);
    layers(integer(0, 3) ? 1 : scene.channels, largest);
    if (integer(0, 2)) return;
    std::vector<double> radii;
    for (size_t i = 0; i < nodes.size(); i++) radii.push_back(nodes[i] / scales[i]);
    field = std::make_unique<Field>(radii, scene.kernel_colours);
    scene.field_masks = field->masks.data();
    scene.distances = Field::distances;
    scene.squeeze = float(number(0.5, 2.0));
  }

 private:
  // Rectangles of one blur each in front of a slope, with small lights; with NaN and infinities if `masked` is set.
  template <typename Integer, typename Number>
  void surfaces(const Integer &integer, const Number &number, double largest) {
    const size_t pixels = size_t(scene.height) * scene.width;
    for (int s = 0; s < scene.surfaces; s++) {
      std::vector<float> colours(pixels * scene.channels), blur(pixels), cover(pixels);
      const double slope = number(-largest, largest) / scene.height;
      const double start = s ? number(0.0, largest) : number(-largest, 0.0);
      for (size_t i = 0; i < pixels; i++)
        blur[i] = float(std::clamp(start + slope * double(i / scene.width), -largest, largest));
      for (int r = integer(0, 5); r > 0; r--) {
        const int top = integer(0, scene.height - 1), bottom = integer(top, scene.height - 1);
        const int left = integer(0, scene.width - 1), right = integer(left, scene.width - 1);
        const float value = float(number(-largest, largest));
        for (int y = top; y <= bottom; y++)
          for (int x = left; x <= right; x++) blur[size_t(y) * scene.width + x] = value;
      }
      for (float &value : colours) value = float(number(0.0, 1.0));
      for (float &value : cover) value = float(std::clamp(number(-0.5, 1.5), 0.0, 1.0));
      for (int r = integer(0, 20); r > 0; r--)
        for (int c = 0, i = integer(0, int(pixels) - 1); c < scene.channels; c++) colours[pixels * c + i] = 500.0f;
      if (scene.masked)
        for (int r = integer(0, 20); r > 0; r--) {
          const float odd[] = {std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()};
          std::vector<float> &hit = integer(0, 1) ? colours : blur;
          hit[integer(0, int(hit.size()) - 1)] = odd[integer(0, 1)];
        }
      light.push_back(colours);
      coc.push_back(blur);
      weight.push_back(cover);
    }
    for (int s = 0; s < scene.surfaces; s++) {
      light_at.push_back(light[s].data());
      coc_at.push_back(coc[s].data());
      weight_at.push_back(scene.kind == TORCHDOF_STACK && s + 1 < scene.surfaces ? weight[s].data() : nullptr);
    }
    scene.light = light_at.data();
    scene.coc = coc_at.data();
    scene.weight = weight_at.data();
  }

  void layers(int colours, double largest) {
    std::vector<double> radii{0.0};
    for (double radius = 1.0; radius < largest * 1.35 + 1.0; radius *= 1.35) radii.push_back(radius);
    for (size_t i = radii.size(); i-- > 1;) nodes.push_back(-radii[i]);
    nodes.insert(nodes.end(), radii.begin(), radii.end());
    for (double node : nodes) {
      const double radius = std::abs(node);
      scales.push_back(radius < 8.0 ? 1 : radius < 16.0 ? 2 : radius < 32.0 ? 4 : 8);
      halves.push_back(radius == 0.0 ? 0 : int(std::ceil(radius / scales.back() + 0.5)));
      const std::vector<float> kernel = disc(radius / scales.back(), halves.back(), colours);
      kernels.insert(kernels.end(), kernel.begin(), kernel.end());
    }
    scene.layers = int32_t(nodes.size());
    scene.nodes = nodes.data();
    scene.scales = scales.data();
    scene.halves = halves.data();
    scene.kernel_colours = colours;
    scene.kernels = kernels.data();
  }
};

// Returns the status, and writes the picture if it is TORCHDOF_OK.
int render(torchdof_scene scene, int threads, const int32_t *cancelled, std::vector<float> &picture) {
  scene.threads = threads;
  scene.cancelled = cancelled;
  torchdof_job *job = nullptr;
  const int begun = torchdof_begin(&scene, &job);
  if (begun != TORCHDOF_OK) return begun;
  const int32_t *steps = nullptr;
  const int64_t count = torchdof_radii(job, &steps);
  std::vector<std::vector<float>> kernels;
  std::vector<const float *> kernels_at;
  std::vector<int32_t> halves;
  for (int64_t i = 0; i < count; i++) {
    const double radius = std::abs(steps[i]) / 32.0;
    halves.push_back(int32_t(std::ceil(radius + 0.5)));
    kernels.push_back(disc(radius, halves.back(), scene.kernel_colours));
  }
  for (const std::vector<float> &kernel : kernels) kernels_at.push_back(kernel.data());
  picture.assign(size_t(scene.channels) * scene.height * scene.width, -1.0f);
  std::vector<double> radii;
  for (double radius = 128.0; radius > 0.5; radius /= 1.3)
    radii.insert(radii.begin() + long(radii.size() / 2), {-radius, radius});
  const Field rays(radii, scene.kernel_colours);
  const torchdof_field_mask *masks = scene.field_masks ? rays.masks.data() : nullptr;
  const int32_t masks_count = scene.field_masks ? int32_t(radii.size()) : 0;
  const int finished = torchdof_finish(job, kernels_at.data(), halves.data(), masks, masks_count, picture.data());
  torchdof_free(job);
  return finished;
}

bool same_bits(const std::vector<float> &a, const std::vector<float> &b) {
  return a.size() == b.size() && std::memcmp(a.data(), b.data(), a.size() * sizeof(float)) == 0;
}

void check(unsigned seed) {
  const int number = int(seed);
  const Scene scene(seed);
  const int32_t never = 0;
  std::vector<float> alone;
  if (render(scene.scene, 1, &never, alone) != TORCHDOF_OK) fail("one thread cannot render it", number);
  if (!scene.scene.masked)
    for (float value : alone)
      if (!std::isfinite(value)) fail("finite light gives a picture that is not", number);

  float low = 0, high = 0;
  if (torchdof_ends(alone.data(), int64_t(alone.size()), 3, &low, &high) != TORCHDOF_OK)
    fail("its ends cannot be told", number);
  if (!scene.scene.masked &&
      (low != *std::min_element(alone.begin(), alone.end()) || high != *std::max_element(alone.begin(), alone.end())))
    fail("its ends are wrong", number);

  std::vector<std::thread> callers;
  for (int threads : {2, 3, 8})
    callers.emplace_back([&, threads] {
      std::vector<float> picture;
      if (render(scene.scene, threads, &never, picture) != TORCHDOF_OK)
        fail("several threads cannot render it", number);
      if (!same_bits(alone, picture)) fail("the number of threads changes the picture", number);
    });
  int32_t cancelled = 0;
  callers.emplace_back([&] {
    std::vector<float> picture;
    const int result = render(scene.scene, 2, &cancelled, picture);
    if (result != TORCHDOF_CANCELLED && result != TORCHDOF_OK) fail("cancelling is an error", number);
    if (result == TORCHDOF_OK && !same_bits(alone, picture)) fail("cancelling too late changes the picture", number);
  });
  __atomic_store_n(&cancelled, 1, __ATOMIC_RELAXED);
  for (std::thread &caller : callers) caller.join();
}

// Checks that the result of `compute` is finite, and the same for any number of threads. `what` names it.
template <typename Compute>
void check_threads(const Compute &compute, const char *what, int scene) {
  const std::vector<float> alone = compute(1);
  if (!std::all_of(alone.begin(), alone.end(), [](float value) { return std::isfinite(value); })) {
    std::fprintf(stderr, "driver: %s\n", what);
    fail("it is not finite", scene);
  }
  std::vector<std::thread> callers;
  for (int threads : {2, 5})
    callers.emplace_back([&, threads] {
      if (same_bits(alone, compute(threads))) return;
      std::fprintf(stderr, "driver: %s\n", what);
      fail("it depends on the number of threads", scene);
    });
  for (std::thread &caller : callers) caller.join();
}

// Depth edges of a scene, steps and ramps.
void check_edges(unsigned seed) {
  const Scene made(seed);
  const torchdof_scene &scene = made.scene;
  const size_t pixels = size_t(scene.height) * scene.width;
  std::vector<float> nearness = made.coc[0];
  for (size_t i = 0; seed % 2 && i + 2 < pixels; i++)
    nearness[i] = (made.coc[0][i] + made.coc[0][i + 1] + made.coc[0][i + 2]) / 3;
  const std::vector<float> steps(pixels, 0.5f);
  const auto repair = [&](int threads) {
    std::vector<float> out(pixels);
    const int32_t never = 0;
    const torchdof_map map = {scene.height,
                              scene.width,
                              scene.channels,
                              made.light[0].data(),
                              nearness.data(),
                              int(seed) % 2,
                              seed % 3 ? nullptr : steps.data(),
                              1.0f,
                              int(seed) % 5 == 0,
                              int(seed) % 7 == 0,
                              int(seed) % 4 == 0,
                              int(seed) % 4 - 1,
                              int(seed) % 3 == 0,
                              threads,
                              &never,
                              out.data()};
    int32_t changed = 0, asked = 0;
    double doubt = 0.0;
    if (torchdof_repair_edges(&map, &changed, &doubt, &asked) != TORCHDOF_OK)
      fail("its edges cannot be repaired", int(seed));
    if (changed != 1) out = nearness;
    if (map.is_coc) {
      const std::vector<float> repaired = out;
      torchdof_map of_repaired = map;
      of_repaired.nearness = repaired.data();
      std::vector<float> grown(pixels);
      of_repaired.out = grown.data();
      if (torchdof_missed_parts(&of_repaired, &doubt) != TORCHDOF_OK) fail("it cannot grow", int(seed));
      if (torchdof_blurred_in_doubt(nearness.data(), grown.data(), map.height, map.width, 0.7f, threads, out.data()))
        fail("its edges cannot be blurred", int(seed));
    }
    for (size_t i = 0; i < pixels; i++) {
      if (std::isfinite(nearness[i])) continue;
      if (std::memcmp(&out[i], &nearness[i], sizeof(float))) fail("a value that is not finite is changed", int(seed));
      out[i] = 0.0f;
    }
    return out;
  };
  check_threads(repair, "repaired edges", int(seed));
}

std::vector<float> noise(std::mt19937 &random, size_t count, double low, double high) {
  std::uniform_real_distribution<> number(low, high);
  std::vector<float> values(count);
  for (float &value : values) value = float(number(random));
  return values;
}

void append(std::vector<float> &all, const std::vector<float> &more) {
  all.insert(all.end(), more.begin(), more.end());
}

// Blends one surface or two with the layers of a scene, and computes the gradient.
void check_blend(unsigned seed) {
  const Scene made(seed);
  std::mt19937 random(seed);
  const auto integer = [&](int low, int high) { return std::uniform_int_distribution<int>(low, high)(random); };
  const int largest = *std::max_element(made.scales.begin(), made.scales.end());
  torchdof_layers frame{};
  frame.margin = largest * integer(1, 3);
  frame.height = largest * integer(1, 80 / largest);
  frame.width = largest * integer(1, 120 / largest);
  frame.rows = frame.height + 2 * frame.margin;
  frame.columns = frame.width + 2 * frame.margin;
  frame.channels = made.scene.channels;
  frame.surfaces = integer(1, 2);
  frame.occlusion = integer(0, 3) > 0;
  frame.backed = integer(0, 1);
  frame.layers = made.scene.layers;
  frame.nodes = made.scene.nodes;
  frame.scales = made.scene.scales;
  frame.halves = made.scene.halves;
  frame.kernel_colours = made.scene.kernel_colours;
  frame.kernels = made.scene.kernels;
  const size_t pixels = size_t(frame.rows) * frame.columns;
  std::vector<float> light[2], place[2], weight[2];
  const float *light_at[2], *place_at[2], *weight_at[2];
  for (int s = 0; s < frame.surfaces; s++) {
    const double ends[] = {made.nodes[integer(0, frame.layers - 1)], made.nodes[integer(0, frame.layers - 1)]};
    light[s] = noise(random, pixels * frame.channels, 0.0, 1.0);
    place[s] = noise(random, pixels, std::min(ends[0], ends[1]), std::max(ends[0], ends[1]));
    for (int r = integer(0, 20); r > 0; r--) place[s][integer(0, int(pixels) - 1)] = float(ends[r % 2]);
    weight[s] = noise(random, integer(0, 1) ? pixels : 0, 0.0, 1.0);
    light_at[s] = light[s].data();
    place_at[s] = place[s].data();
    weight_at[s] = weight[s].empty() ? nullptr : weight[s].data();
  }
  frame.light = light_at;
  frame.place = place_at;
  frame.weight = weight_at;
  const size_t planes = frame.channels + frame.kernel_colours;
  const std::vector<float> slopes = noise(random, planes * frame.height * frame.width, -1.0, 1.0);
  const auto blend = [&](int threads) {
    const int32_t never = 0, cancelled = 1;
    torchdof_layers its_frame = frame;
    its_frame.threads = threads;
    its_frame.cancelled = &cancelled;
    std::vector<float> all(slopes.size());
    const int result = torchdof_blend(&its_frame, all.data(), nullptr, nullptr, nullptr, nullptr);
    if (result != TORCHDOF_CANCELLED && result != TORCHDOF_OK) fail("cancelling its layers is an error", int(seed));
    its_frame.cancelled = &never;
    if (torchdof_blend(&its_frame, all.data(), nullptr, nullptr, nullptr, nullptr) != TORCHDOF_OK)
      fail("its layers cannot be blended", int(seed));
    std::vector<float> of_light[2], of_place[2], of_weight[2];
    float *of_light_at[2], *of_place_at[2], *of_weight_at[2];
    for (int s = 0; s < frame.surfaces; s++) {
      of_light[s].assign(light[s].size(), 0.0f);
      of_place[s].assign(place[s].size(), 0.0f);
      of_weight[s].assign(weight[s].size(), 0.0f);
      of_light_at[s] = of_light[s].data();
      of_place_at[s] = of_place[s].data();
      of_weight_at[s] = weight[s].empty() ? nullptr : of_weight[s].data();
    }
    if (torchdof_blend(&its_frame, nullptr, slopes.data(), of_light_at, of_place_at, of_weight_at) != TORCHDOF_OK)
      fail("its layers have no gradient", int(seed));
    for (int s = 0; s < frame.surfaces; s++)
      for (const std::vector<float> *part : {&of_light[s], &of_place[s], &of_weight[s]}) append(all, *part);
    return all;
  };
  check_threads(blend, "blended layers", int(seed));
}

// Reads the surfaces behind pixels or cells from the levels of a pyramid, and computes the gradient.
void check_look_behind(unsigned seed) {
  std::mt19937 random(seed);
  const auto integer = [&](int low, int high) { return std::uniform_int_distribution<int>(low, high)(random); };
  const int channels = integer(1, torchdof::constants::native::MOST_PLANES),
            count = integer(1, torchdof::constants::native::MOST_LEVELS);
  const int rows = (2 << count) * integer(1, 5), columns = (2 << count) * integer(1, 7);  // pixels of all levels
  const int height = integer(1, rows), width = integer(1, columns);
  const size_t pixels = size_t(height) * width;
  std::vector<std::vector<float>> values;
  std::vector<torchdof_level> levels;
  for (int l = 0; l < count; l++) {
    const int step = 2 << l;
    const size_t size = size_t(rows / step) * (columns / step);
    values.push_back(noise(random, size * channels, 0.0, 1.0));
    append(values[l], noise(random, size, -20.0, 20.0));
    append(values[l], noise(random, size, 0.0, 1.0));
    levels.push_back({values[l].data(), rows / step, columns / step, step, 0.5f * step, 4.0f, 2.0f});
  }
  const std::vector<float> coc = noise(random, pixels, -20.0, 20.0), random_wanted = noise(random, pixels, -1.0, 0.1);
  const float *const wanted = integer(0, 1) ? random_wanted.data() : nullptr;
  const size_t places = wanted ? size_t(rows / 4) * (columns / 4) * (count > 2 ? 2 : 1) : pixels;
  const std::vector<float> slopes = noise(random, (channels + 2) * places, -1.0, 1.0);
  const auto look = [&](int threads) {
    std::vector<float> all(slopes.size()), of_coc(pixels);
    std::vector<std::vector<float>> of_levels;
    std::vector<float *> of_levels_at;
    for (const std::vector<float> &of_level : values) of_levels.emplace_back(of_level.size(), 0.0f);
    for (std::vector<float> &of_level : of_levels) of_levels_at.push_back(of_level.data());
    if (torchdof_look_behind(levels.data(), count, channels, coc.data(), wanted, height, width, threads, all.data(),
                             nullptr, nullptr, nullptr) != TORCHDOF_OK)
      fail("surfaces behind cannot be found", int(seed));
    if (torchdof_look_behind(levels.data(), count, channels, coc.data(), wanted, height, width, threads, nullptr,
                             slopes.data(), of_levels_at.data(), of_coc.data()) != TORCHDOF_OK)
      fail("surfaces behind have no gradient", int(seed));
    append(all, of_coc);
    for (const std::vector<float> &of_level : of_levels) append(all, of_level);
    return all;
  };
  check_threads(look, "surfaces behind", int(seed));
}

// Splits the mixed pixels of an image with some steps in its coc, and computes the gradient.
void check_matte(unsigned seed) {
  std::mt19937 random(seed);
  const auto integer = [&](int low, int high) { return std::uniform_int_distribution<int>(low, high)(random); };
  const int channels = integer(1, 5), height = integer(1, 60), width = integer(1, 80);
  const size_t pixels = size_t(height) * width, planes = 2 * channels + 2;
  std::vector<float> light = noise(random, pixels * channels, -0.1, 1.0), coc = noise(random, pixels, -0.1, 0.1);
  for (int y = 0, column = integer(0, width); y < height; y++)
    for (int x = column; x < width; x++) coc[size_t(y) * width + x] += 3.0f;
  const std::vector<float> valid(pixels, 1.0f), slopes = noise(random, planes * pixels, -1.0, 1.0);
  const float *maps[] = {light.data(), coc.data(), integer(0, 1) ? valid.data() : nullptr};
  const auto split = [&](int threads) {
    std::vector<float> all(slopes.size()), of_light(light.size()), of_coc(pixels);
    float *const of_maps[] = {of_light.data(), of_coc.data()};
    if (torchdof_matte(maps, channels, height, width, threads, all.data(), nullptr, nullptr) != TORCHDOF_OK ||
        torchdof_matte(maps, channels, height, width, threads, nullptr, slopes.data(), of_maps) != TORCHDOF_OK)
      fail("its mixed pixels cannot be split", int(seed));
    append(all, of_light);
    append(all, of_coc);
    return all;
  };
  check_threads(split, "mixed pixels", int(seed));
}

// Continues the light of some surfaces beyond the frame's border, and computes the gradient.
void check_continued(unsigned seed) {
  std::mt19937 random(seed);
  const auto integer = [&](int low, int high) { return std::uniform_int_distribution<int>(low, high)(random); };
  const int surfaces = integer(1, 3), channels = integer(1, 5), height = integer(1, 40), width = integer(1, 60);
  const int32_t ends[] = {integer(0, 50), integer(0, 50), integer(0, 50), integer(0, 50)};
  const size_t pixels = size_t(height) * width, wide = size_t(height + ends[2] + ends[3]) * (width + ends[0] + ends[1]);
  std::vector<std::vector<float>> maps;  // light, coc and weight of each surface; limit
  for (int s = 0; s < 3 * surfaces; s++)
    maps.push_back(noise(random, (s < surfaces ? channels : 1) * pixels, 0.0, s / surfaces == 1 ? 9.0 : 1.0));
  maps.push_back(noise(random, pixels, 0.3, 1.3));
  const int image = integer(-1, surfaces - 1);
  const std::vector<float> slopes = noise(random, surfaces * (channels + 2) * wide, -1.0, 1.0);
  const auto run = [&](int threads) {
    std::vector<float> all(slopes.size());
    std::vector<const float *> maps_at;
    std::vector<std::vector<float>> of_maps;
    std::vector<float *> of_maps_at;
    for (const std::vector<float> &map : maps) of_maps.emplace_back(map.size(), 0.0f), maps_at.push_back(map.data());
    for (std::vector<float> &of_map : of_maps) of_maps_at.push_back(of_map.data());
    const auto step = [&](float *out, const float *gradient, float *const *of) {
      return torchdof_continued(maps_at.data(), surfaces, channels, height, width, ends, 0.5f, 7.0f, image, threads,
                                out, gradient, of);
    };
    if (step(all.data(), nullptr, nullptr) != TORCHDOF_OK) fail("its light cannot be continued", int(seed));
    if (step(nullptr, slopes.data(), of_maps_at.data()) != TORCHDOF_OK)
      fail("its continued light has no gradient", int(seed));
    for (const std::vector<float> &of_map : of_maps) append(all, of_map);
    return all;
  };
  check_threads(run, "continued light", int(seed));
}

}  // namespace

int main(int count, char **arguments) {
  const int scenes = count > 1 ? std::atoi(arguments[1]) : 24;
  for (int seed = 0; seed < scenes; seed++) {
    check(unsigned(seed));
    check_edges(unsigned(seed));
    check_blend(unsigned(seed));
    check_look_behind(unsigned(seed));
    check_matte(unsigned(seed));
    check_continued(unsigned(seed));
  }
  std::printf("%s: %d scenes\n", arguments[0], scenes);
}
