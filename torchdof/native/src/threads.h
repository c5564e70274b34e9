// One pool of threads that lives as long as the process.
#pragma once
#include <functional>

namespace torchdof {

struct Cancelled {};
struct TooBright {};

// Calls body(index, worker) for every index below count, on the calling thread and up to threads - 1 others. Workers
// are numbered from 0, so that each can have memory of its own. Which worker takes which index is left to chance;
// results must not depend on it. Throws Cancelled soon after *cancelled becomes 1.
void parallel(int threads, int count, const volatile int *cancelled, const std::function<void(int, int)> &body);

}  // namespace torchdof
