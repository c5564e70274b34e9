#include "memory.h"

#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <new>
#include <vector>

namespace torchdof {
namespace {

constexpr size_t KEPT_BYTES = size_t(192) << 20;  // upper limit of the memory kept
constexpr size_t LEAST_BYTES = size_t(64) << 10;  // smaller blocks are left to malloc
constexpr size_t HEADER = 64;

struct Header {
  size_t bytes;
  void *start;  // of the allocation
};

struct Kept {
  std::mutex mutex;  // only try_lock: after a fork a thread that no longer exists may hold it
  std::vector<Header *> blocks;
  size_t bytes = 0;
};
Kept &kept() {
  static Kept *kept = new Kept();  // never destroyed: threads may outlive it
  return *kept;
}

void *after(Header *header) { return reinterpret_cast<char *>(header) + HEADER; }

}  // namespace

void *take_memory(size_t bytes) {
  if (bytes >= LEAST_BYTES) {
    Kept &k = kept();
    std::unique_lock<std::mutex> lock(k.mutex, std::try_to_lock);
    if (lock) {
      size_t best = k.blocks.size();
      for (size_t i = 0; i < k.blocks.size(); i++)
        if (k.blocks[i]->bytes >= bytes && k.blocks[i]->bytes / 4 * 3 <= bytes &&
            (best == k.blocks.size() || k.blocks[i]->bytes < k.blocks[best]->bytes))
          best = i;
      if (best < k.blocks.size()) {
        Header *header = k.blocks[best];
        k.blocks.erase(k.blocks.begin() + best);
        k.bytes -= header->bytes;
        return after(header);
      }
    }
  }
  if (bytes > SIZE_MAX - 2 * HEADER) throw std::bad_alloc();
  void *start = std::malloc(bytes + 2 * HEADER);
  if (!start) throw std::bad_alloc();
  const uintptr_t aligned = (reinterpret_cast<uintptr_t>(start) + HEADER - 1) / HEADER * HEADER;
  Header *header = reinterpret_cast<Header *>(aligned);
  header->bytes = bytes;
  header->start = start;
  return after(header);
}

void give_memory(void *memory) {
  if (!memory) return;
  Header *header = reinterpret_cast<Header *>(reinterpret_cast<char *>(memory) - HEADER);
  if (header->bytes >= LEAST_BYTES && header->bytes <= KEPT_BYTES) {
    Kept &k = kept();
    std::unique_lock<std::mutex> lock(k.mutex, std::try_to_lock);
    if (lock) {
      try {
        k.blocks.push_back(header);
      } catch (const std::bad_alloc &) {
        std::free(header->start);
        return;
      }
      k.bytes += header->bytes;
      while (k.bytes > KEPT_BYTES) {  // the oldest goes first
        Header *oldest = k.blocks.front();
        k.blocks.erase(k.blocks.begin());
        k.bytes -= oldest->bytes;
        std::free(oldest->start);
      }
      return;
    }
  }
  std::free(header->start);
}

}  // namespace torchdof
