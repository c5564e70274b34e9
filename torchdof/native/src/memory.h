// Memory that is reused between pictures. Allocating it each time, page by page, would take a tenth of the rendering
// time.
#pragma once
#include <cstddef>
#include <memory>

namespace torchdof {

// Returns uninitialized memory, aligned to 64 bytes. Throws std::bad_alloc.
void *take_memory(size_t bytes);
// Frees memory; up to KEPT_BYTES are kept for reuse.
void give_memory(void *memory);

// Uninitialized memory.
template <typename T>
class Buffer {
 public:
  Buffer() = default;
  explicit Buffer(size_t size) : data_(static_cast<T *>(take_memory(size * sizeof(T)))) {}
  T *data() const { return data_.get(); }
  T &operator[](size_t i) const { return data_.get()[i]; }

 private:
  struct Give {
    void operator()(T *data) const { give_memory(data); }
  };
  std::unique_ptr<T, Give> data_;
};

}  // namespace torchdof
