// What the functions of api.h have in common.
#pragma once
#include <cstdint>
#include <new>
#include <stdexcept>

#include "api.h"
#include "threads.h"

namespace torchdof {

// Calls the body of a function of api.h, and returns its status.
template <typename Body>
int32_t guarded(const Body &body) {
  try {
    body();
    return TORCHDOF_OK;
  } catch (const Cancelled &) {
    return TORCHDOF_CANCELLED;
  } catch (const TooBright &) {
    return TORCHDOF_TOO_BRIGHT;
  } catch (const std::bad_alloc &) {
    return TORCHDOF_NO_MEMORY;
  } catch (const std::length_error &) {
    return TORCHDOF_NO_MEMORY;
  }
}

}  // namespace torchdof
