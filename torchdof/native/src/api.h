// The C interface of the compiled engine: from a map of coc to the picture. Plain arrays, no Python, no PyTorch.
//
// A picture takes two calls, for the kernels of highlights are made by the caller, who knows the lens:
// torchdof_begin looks at the scene and tells which radii its highlights have; torchdof_finish renders.
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
  TORCHDOF_TOO_BRIGHT = 3,  // powers of the image's light could overflow: scale it down; other surfaces are not looked at
};

// What the given surfaces are.
enum {
  TORCHDOF_IMAGE = 0,       // one image: its mixed pixels are split, what it hides is filled in
  TORCHDOF_BACKGROUND = 1,  // an image and, second, what is seen where its nearer surfaces are taken away
  TORCHDOF_STACK = 2,       // surfaces that cover each other, near to far, as they are
};

// What the field lets through of a kernel, as optics/placed_kernels.py tells it.
typedef struct {
  const float *values;     // [colours, distances, rows, columns]
  const float *boxes;      // [distances, 3]: middle away from the middle of the frame, half length, width, in its pixels
  float radius;            // signed coc in its pixels
  int32_t colours;         // 1, or channels
  int32_t rows, columns;
} torchdof_shares;

typedef struct {
  int32_t height, width, channels;
  int32_t kind;                // as above
  int32_t surfaces;            // how many are given: 1, 2, or any number
  const float *const *light;   // of each surface [channels, height, width]
  const float *const *coc;     // of each surface [height, width]: signed radius in pixels, negative in front of the focus
  const float *const *weight;  // of each surface [height, width], or null: it covers its pixels wholly
  int32_t occlusion;           // 0: light accumulates, whatever lies in front
  int32_t normalize;           // 0: without occlusion, the plain sum
  int32_t masked;  // 1: values may be NaN or infinite (of a stack never); such pixels pass through and touch nothing else
  int32_t highlights;          // 0: highlights are spread with their layers
  float crisp_px;              // blur from which on layers soften highlights

  int32_t layers;          // near to far
  const double *nodes;     // places of the layers on the blur axis, strictly increasing
  const int32_t *scales;   // each is spread at every so many pixels, a power of two up to 16
  const int32_t *halves;   // its kernel reaches so many of these to each side
  int32_t kernel_colours;  // 1, or channels: kernels for each colour
  const float *kernels;    // one layer after the other, [kernel_colours, 2 half + 1, 2 half + 1]

  const torchdof_shares *shares;  // of each layer; null: kernels are alike everywhere
  int32_t distances;              // from the middle of the frame to its corner at which shares are told
  float squeeze;                  // height of the blur over its width

  int32_t threads;
  const volatile int32_t *cancelled;  // rendering stops soon after it becomes 1
} torchdof_scene;

// out = scale (1 / s - 1 / z): signed coc of depths z [count] in metres, for a focus at s; what lies between two distances is in
// focus. NaN where a depth is not > 0.
TORCHDOF_API int32_t torchdof_coc(const float *depth, int64_t count, float scale, float nearest, float farthest, int32_t threads,
                                  float *out);

// Layers for a frame, of which some maps of coc [maps, height, width] are given: their places on the blur axis, near to far, in
// nodes, as many as fit into its capacity; count: how many there are. tolerance: made smaller for a small frame.
TORCHDOF_API int32_t torchdof_plan(const float *coc, int32_t maps, int32_t height, int32_t width, double *tolerance,
                                   int32_t threads, double *nodes, int32_t capacity, int32_t *count);

// What kernels of some circles of confusion are made from, as Spots of optics/kernel_bank.py has it.
typedef struct {
  int32_t count, colours;         // kernels, and colours of each
  const float *const *templates;  // each [colours, 2 n + 3, 2 n + 3], for its n
  const int32_t *cells;           // n of each template
  const int32_t *index;           // [count, 4]: templates of the nodes below and above, and the same of the finer level
  const double *part, *finer;     // [count]: of the node above, and of the finer level
  const double *reach, *fade;     // [count, colours]: radius in pixels, and share against a single pixel
  const int32_t *flipped, *half;  // [count]: turned by half; pixels that it reaches to each side
  double squeeze;                 // height of the blur over its width
  int32_t round;                  // 1: symmetric about both axes
  int32_t even;                   // 1: even light within the radius; templates are not looked at
} torchdof_spots;

// out[i]: [colours, 2 half[i] + 1, 2 half[i] + 1].
TORCHDOF_API int32_t torchdof_kernels(const torchdof_spots *spots, int32_t threads, float *const *out);

typedef struct torchdof_job torchdof_job;

// The scene must stay as it is until torchdof_finish has returned.
TORCHDOF_API int32_t torchdof_begin(const torchdof_scene *scene, torchdof_job **job);

// Signed radii of highlights, in steps of 1/32 pixel; returns how many.
TORCHDOF_API int64_t torchdof_radii(const torchdof_job *job, const int32_t **steps);

// kernels[i] is for radius i: [kernel_colours, 2 halves[i] + 1, 2 halves[i] + 1]. shares: by growing radius, two at least
// around that of each highlight, where layers have them. out: [channels, height, width].
TORCHDOF_API int32_t torchdof_finish(torchdof_job *job, const float *const *kernels, const int32_t *halves,
                                     const torchdof_shares *shares, int32_t shares_count, float *out);

TORCHDOF_API void torchdof_free(torchdof_job *job);

// A map of nearness (linear in 1 / depth, larger is nearer; what is not finite stays) whose edges are to be where the
// image has them; or of a coc, which is larger where it is farther.
typedef struct {
  int32_t height, width, channels;
  const float *light;     // [channels, height, width]
  const float *nearness;  // [height, width]
  int32_t of_coc;
  const float *steps;     // difference from which on neighbours are two surfaces, [height, width]; or null, then it is
  float step;             // this one everywhere
  int32_t automatic;      // 1: edges that prove exact are left alone
  int32_t threads;
  const volatile int32_t *cancelled;
  float *out;  // [height, width]
} torchdof_map;

// changed: 0 if the map is right as it is; then out is left as it was.
TORCHDOF_API int32_t torchdof_repair_edges(const torchdof_map *map, int32_t *changed);

// Least and largest of numbers; NaN both if one of them is NaN.
TORCHDOF_API int32_t torchdof_ends(const float *values, int64_t count, int32_t threads, float *low, float *high);

// out[y, x] = sum of kernel[v, u] in[y - v, x - u]: what spreads a layer. For tests and benchmarks.
TORCHDOF_API void torchdof_convolve(const float *in, int32_t height, int32_t width, const float *kernel, int32_t half,
                                    float *out);

// What a caller compares with its own idea of this file before it calls anything else: sizes of the two structures and,
// in the upper half, a number that goes up with every other change of this file.
#define TORCHDOF_REVISION 5
TORCHDOF_API int64_t torchdof_interface(void);

// "avx2" or "baseline".
TORCHDOF_API const char *torchdof_instructions(void);
// Chooses them, for tests; returns 0 if the processor lacks them.
TORCHDOF_API int32_t torchdof_use(const char *instructions);
