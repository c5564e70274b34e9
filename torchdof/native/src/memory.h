// Memory that is kept between pictures: to take it anew each time, page by page, costs a tenth of a rendering.
#pragma once
#include <cstddef>

namespace torchdof {

// At least so many bytes, aligned to 64, as they are found. Throws std::bad_alloc.
void *take_memory(size_t bytes);
// Gives them back; a bounded number of bytes is kept for the next to ask.
void give_memory(void *memory);

}  // namespace torchdof
