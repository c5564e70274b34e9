#include "memory.h"

#include <cstdint>
#include <cstdlib>
#include <mutex>
#include <new>

namespace torchdof {
namespace {

constexpr size_t KEPT_BYTES = size_t(192) << 20;  // upper limit of the memory kept
constexpr size_t LEAST_BYTES = size_t(64) << 10;  // smaller blocks are left to malloc
constexpr size_t HEADER = 64;

struct Header {
  size_t bytes;
  void *start;   // of the allocation
  Header *next;  // the block kept before this one
};

struct Kept {
  std::mutex mutex;  // only try_lock: after a fork a thread that no longer exists may hold it
  Header *last = nullptr;
  size_t bytes = 0;

  // Takes a block out of the list.
  Header *take(Header **place) {
    Header *header = *place;
    *place = header->next;
    bytes -= header->bytes;
    return header;
  }
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
    for (Header **place = &k.last; lock && *place; place = &(*place)->next)
      if ((*place)->bytes >= bytes && (*place)->bytes / 4 * 3 <= bytes) return after(k.take(place));
  }
  if (bytes > SIZE_MAX - 2 * HEADER) throw std::bad_alloc();
  void *start = std::malloc(bytes + 2 * HEADER);
  if (!start) throw std::bad_alloc();
  const uintptr_t aligned = (reinterpret_cast<uintptr_t>(start) + HEADER - 1) / HEADER * HEADER;
  return after(new (reinterpret_cast<void *>(aligned)) Header{bytes, start, nullptr});
}

void give_memory(void *memory) {
  Header *header = reinterpret_cast<Header *>(reinterpret_cast<char *>(memory) - HEADER);
  if (header->bytes >= LEAST_BYTES && header->bytes <= KEPT_BYTES) {
    Kept &k = kept();
    std::unique_lock<std::mutex> lock(k.mutex, std::try_to_lock);
    if (lock) {
      header->next = k.last;
      k.last = header;
      k.bytes += header->bytes;
      while (k.bytes > KEPT_BYTES) {  // the oldest goes first
        Header **oldest = &k.last;
        while ((*oldest)->next) oldest = &(*oldest)->next;
        std::free(k.take(oldest)->start);
      }
      return;
    }
  }
  std::free(header->start);
}

}  // namespace torchdof
