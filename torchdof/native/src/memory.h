// Memory that is reused between pictures. Allocating it each time, page by page, would take a tenth of the rendering
// time.
#pragma once
#include <cstddef>

namespace torchdof {

// Returns uninitialized memory, aligned to 64 bytes. Throws std::bad_alloc.
void *take_memory(size_t bytes);
// Frees memory; up to KEPT_BYTES are kept for reuse.
void give_memory(void *memory);

}  // namespace torchdof
