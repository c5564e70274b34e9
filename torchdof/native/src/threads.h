// One pool of threads for the whole process.
#pragma once
#include <functional>

namespace torchdof {

struct Cancelled {};
struct TooBright {};

// Calls body(index, worker) for every index below count, on the calling thread and up to threads - 1 others. worker
// counts from 0, so that each can have its own buffers. Which worker gets which index varies; results must not depend
// on it. Throws Cancelled soon after *cancelled becomes 1.
void parallel(int threads, int count, const volatile int *cancelled, const std::function<void(int, int)> &body);

}  // namespace torchdof
