// The C interface of the compiled engine: plain arrays, no Python, no PyTorch.
//
// A picture takes two calls, because the caller, who has the lens's table, makes the kernels of highlights:
// torchdof_begin prepares the scene and finds the radii of its highlights; torchdof_finish renders.
#pragma once
#include <stdint.h>

#if defined(_WIN32)
#define TORCHDOF_API extern "C" __declspec(dllexport)
#else
#define TORCHDOF_API extern "C" __attribute__((visibility("default")))
#endif

enum {
  TORCHDOF_OK = 0,
  TORCHDOF_NO_MEMORY = 1,
  TORCHDOF_CANCELLED = 2,
  // sums of squares of the image's light could overflow: scale it down. Only the image is checked.
  TORCHDOF_TOO_BRIGHT = 3,
};

// Meaning of the surfaces passed in.
enum {
  TORCHDOF_IMAGE = 0,       // one image: mixed pixels are split, hidden areas are filled
  TORCHDOF_BACKGROUND = 1,  // an image, and a second one without its nearer surfaces
  TORCHDOF_STACK = 2,       // surfaces that cover each other, near to far; used unchanged
};

// Transmittance of the lens's field over a kernel; see optics/placed_kernels.py.
typedef struct {
  const float *values;  // [colours, distances, rows, columns]
  // [distances, 3]: where the samples lie: offset of their centre along the radius, half length, half width
  const float *boxes;
  float radius;     // signed coc in pixels of the layer
  int32_t colours;  // 1 or channels
  int32_t rows, columns;
} torchdof_field_mask;

typedef struct {
  int32_t height, width, channels;
  int32_t kind;               // TORCHDOF_IMAGE, _BACKGROUND or _STACK
  int32_t surfaces;           // number of surfaces: 1, 2, or any number
  const float *const *light;  // for each surface [channels, height, width]
  const float *const *coc;  // for each surface [height, width]: signed radius in pixels, negative in front of the focus
  const float *const *weight;  // for each surface [height, width], or null: it covers its pixels fully
  const float *covered;        // second surfaces that a matte gives [channels + 3, height, width], or null; see
                               // render/surfaces/coverage.py
  int32_t occlusion;           // 0: light of all surfaces is added, without occlusion
  int32_t normalize;           // 0: without occlusion, do not divide by the blurred weight
  int32_t masked;  // 1: inputs may be NaN or infinite (not in a stack); such pixels are copied and do not affect others
  int32_t highlights;  // 0: highlights are blurred with their layers
  float crisp_px;      // blur in pixels above which layers soften the outlines of highlights
  float reach;         // radius of the widest kernel divided by the radius of its disc, at least 1

  int32_t layers;          // near to far
  const double *nodes;     // positions of the layers on the blur axis, strictly increasing
  const int32_t *scales;   // pixel size of each layer, a power of two up to 16
  const int32_t *halves;   // half width of each kernel in pixels of its layer
  int32_t kernel_colours;  // 1 or channels
  const float *kernels;    // for each layer [kernel_colours, 2 half + 1, 2 half + 1]

  const torchdof_field_mask *field_masks;  // for each layer; null: kernels do not change across the frame
  int32_t distances;                       // number of field distances, from the centre of the frame to its corner
  float squeeze;                           // height of the blur divided by its width

  int32_t threads;
  const volatile int32_t *cancelled;  // rendering stops soon after it becomes 1
} torchdof_scene;

// out = scale (1 / s - 1 / z): signed coc of depths z [count] in metres; s is nearest or farthest, and depths between
// them are in focus. NaN where z is not > 0.
TORCHDOF_API int32_t torchdof_coc(const float *depth, int64_t count, float scale, float nearest, float farthest,
                                  int32_t threads, float *out);

// Positions of the layers on the blur axis, near to far, for maps of coc [maps, height, width] of one frame. count:
// number of layers; nodes is written if they fit into its capacity. tolerance: reduced for a small frame.
TORCHDOF_API int32_t torchdof_plan(const float *coc, int32_t maps, int32_t height, int32_t width, double *tolerance,
                                   int32_t threads, double *nodes, int32_t capacity, int32_t *count);

// Input from which kernels are made; the same as Spots of optics/kernel_bank.py.
typedef struct {
  int32_t count, colours;         // number of kernels, and of colours of each
  const float *const *templates;  // each [colours, 2 n + 3, 2 n + 3], for its n
  const int32_t *cells;           // n of each template
  const int32_t *index;           // [count, 4]: templates of the nodes below and above; the same of the finer level
  const double *part, *finer;     // [count]: interpolation weight of the node above, and of the finer level
  const double *reach, *fade;     // [count, colours]: radius in pixels; weight against an unblurred pixel
  const int32_t *flipped, *half;  // [count]: 1 if rotated by half a turn; half width in pixels
  double squeeze;                 // height of the blur divided by its width
  int32_t round;                  // 1: symmetric about both axes
  int32_t even;                   // 1: constant light within the radius; templates are not used
} torchdof_spots;

// out[i]: [colours, 2 half[i] + 1, 2 half[i] + 1].
TORCHDOF_API int32_t torchdof_kernels(const torchdof_spots *spots, int32_t threads, float *const *out);

typedef struct torchdof_job torchdof_job;

// The scene must not change until torchdof_finish has returned.
TORCHDOF_API int32_t torchdof_begin(const torchdof_scene *scene, torchdof_job **job);

// Signed radii of highlights in steps of 1/32 pixel; returns their number.
TORCHDOF_API int64_t torchdof_radii(const torchdof_job *job, const int32_t **steps);

// kernels[i] is for radius i: [kernel_colours, 2 halves[i] + 1, 2 halves[i] + 1]. field_masks: field masks, at least
// two, in ascending order of radius; null if layers have no masks. out: [channels, height, width].
TORCHDOF_API int32_t torchdof_finish(torchdof_job *job, const float *const *kernels, const int32_t *halves,
                                     const torchdof_field_mask *field_masks, int32_t field_masks_count, float *out);

TORCHDOF_API void torchdof_free(torchdof_job *job);

// A map whose edges are moved to those of the image: nearness (linear in 1 / depth, larger is nearer), or coc (larger
// is farther). Values that are not finite stay.
typedef struct {
  int32_t height, width, channels;
  const float *light;     // [channels, height, width]
  const float *nearness;  // [height, width]
  int32_t is_coc;         // 1: `nearness` is coc
  const float *steps;     // smallest difference between two surfaces [height, width], or null:
  float step;             // the same for all pixels
  int32_t automatic;      // 1: leave a map with exact edges unchanged
  int32_t stops_if_wide;  // 1: leave a map with ramps too wide to be found unchanged, with `changed` = 2
  int32_t is_related;     // 1: the colours are known to be related to the map
  int32_t stops;          // bits of the edits for which to leave a map unchanged, if colours ask for one of them
  int32_t eroded;         // 1: foregrounds were too wide and have been eroded
  int32_t threads;
  const volatile int32_t *cancelled;
  float *out;  // [height, width]
} torchdof_map;

// changed: 0 if the map needs no repair, 2 if it stops because of its ramps; out is then not written. doubt: how much
// the map is in doubt, 0 to 1, less how far its foregrounds are dilated, 0 to 1. edits: those that colours ask for,
// a bit each, in the order of render/surfaces/registration.py.
TORCHDOF_API int32_t torchdof_repair_edges(const torchdof_map *map, int32_t *changed, double *doubt, int32_t *edits);

// Gives missed fine parts of blurred foregrounds to them, in a map of coc; reads no members from steps to eroded.
// share: how far the map has missed parts, 0 to 1.
TORCHDOF_API int32_t torchdof_missed_parts(const torchdof_map *map, double *share);

// Blurs the edges of a map of coc [height, width] that is in doubt, from the map before its repair and after it.
TORCHDOF_API int32_t torchdof_blurred_in_doubt(const float *given, const float *repaired, int32_t height, int32_t width,
                                               float doubt, int32_t threads, float *out);

// A padded frame whose layers are blurred and composited: surfaces of each pixel, all of them with a margin.
typedef struct {
  int32_t rows, columns;       // of the maps; multiples of the largest scale, as is the margin
  int32_t margin;              // pixels of the maps before the picture
  int32_t height, width;       // of the picture, multiples of the largest scale
  int32_t channels;            // with kernel_colours at most MOST_PLANES of native/__init__.py
  int32_t surfaces;            // 1, or 2 that share each pixel
  const float *const *light;   // for each surface [channels, rows, columns]
  const float *const *place;   // for each surface [rows, columns]: position on the blur axis
  const float *const *weight;  // for each surface [rows, columns], or null: it covers its pixels fully
  int32_t occlusion;           // 0: light and weights of all layers are added
  int32_t backed;  // 1: there is light behind all surfaces, so the transmittance is computed, not the coverage

  int32_t layers;  // as in torchdof_scene
  const double *nodes;
  const int32_t *scales, *halves;
  int32_t kernel_colours;
  const float *kernels;

  int32_t threads;
  const volatile int32_t *cancelled;
} torchdof_layers;

// Steps with a gradient. Without `gradient` they write `out`; else, given the gradient of `out`, they add to the
// gradients of the inputs, which have the inputs' shapes, and write nothing else.

// out: [channels + kernel_colours, height, width]: light, and coverage or transmittance, or sum of weights. A surface
// without weight has no gradient of the weight.
TORCHDOF_API int32_t torchdof_blend(const torchdof_layers *layers, float *out, const float *gradient,
                                    float *const *d_light, float *const *d_place, float *const *d_weight);

// A level of the pyramid from which hidden surfaces are filled; see render/surfaces/disocclusion.py.
typedef struct {
  const float *values;    // [channels + 2, rows, columns]: light, coc, weight
  int32_t rows, columns;  // at least 2
  int32_t step;           // pixels between two samples; all levels cover the same pixels
  float least_px;         // blur above which a pixel reads the level
  float slope, most;      // votes for each weight of the samples, and largest number of votes
} torchdof_level;

// Splits the mixed pixels of an image; see render/surfaces/matting.py. maps: light [channels, height, width], coc
// [height, width], and 0 for pixels that are left out [height, width] or null. out: own and other light, coc and weight
// of the other surface, [2 channels + 2, height, width]. The first two maps have gradients.
TORCHDOF_API int32_t torchdof_matte(const float *const *maps, int32_t channels, int32_t height, int32_t width,
                                    int32_t threads, float *out, const float *gradient, float *const *d_maps);

// The finest level of that pyramid, [channels + 2, rows, columns], from the surfaces of an image. maps: light
// [channels, height, width], coc [height, width]; the same of each pixel's other surface, and its weight; light above
// which a pixel is a highlight; and 0 for pixels that are left out, or null. The first five maps have gradients.
// Without another surface and a threshold, all null, it is the next level, from the light, coc and weight of a finer
// one.
TORCHDOF_API int32_t torchdof_farthest(const float *const *maps, int32_t channels, int32_t height, int32_t width,
                                       int32_t rows, int32_t columns, int32_t threads, float *out,
                                       const float *gradient, float *const *d_maps);

// The surfaces behind pixels with coc [height, width], from levels fine to coarse. out: light, coc and votes, [channels
// + 2, height, width].
//
// If wanted [height, width] is not null, those behind all cells of 4 x 4 pixels that the levels cover. A cell without a
// wanted pixel, one that is not 0, has no votes. out: light, coc and votes of the farthest surface, [channels + 2,
// rows, columns]; with more than two levels, also those of the mean of all but the finest two.
TORCHDOF_API int32_t torchdof_look_behind(const torchdof_level *levels, int32_t count, int32_t channels,
                                          const float *coc, const float *wanted, int32_t height, int32_t width,
                                          int32_t threads, float *out, const float *gradient, float *const *d_levels,
                                          float *d_coc);

// Surfaces continued beyond the frame's border: light, position on the blur axis and weight of each [surfaces, channels
// + 2, height + ends, width + ends]; see render/surfaces/border.py. maps: light of each surface [channels, height,
// width], coc of each, weight of each, and light above which a pixel is a highlight, [height, width]. ends: pixels
// added at the left, right, top and bottom. low, high: ends of the blur axis. image: the image's own surface, or -1:
// each one is an image. All maps but the last have gradients.
TORCHDOF_API int32_t torchdof_continued(const float *const *maps, int32_t surfaces, int32_t channels, int32_t height,
                                        int32_t width, const int32_t *ends, float low, float high, int32_t image,
                                        int32_t threads, float *out, const float *gradient, float *const *d_maps);

// Smallest and largest value; both NaN if any value is NaN.
TORCHDOF_API int32_t torchdof_ends(const float *values, int64_t count, int32_t threads, float *low, float *high);

// Checksum of the text of this file that it was compiled with. The caller compares it with that of the file from which
// it takes the structures and functions, before it calls any other function.
TORCHDOF_API int64_t torchdof_interface(void);

// Checksum of the constants of Python modules that it was compiled with; cmake/constants.py computes that of the
// sources.
TORCHDOF_API int64_t torchdof_constants(void);
