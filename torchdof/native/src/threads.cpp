#include "threads.h"

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <deque>
#include <exception>
#include <mutex>
#include <thread>

#if !defined(_WIN32)
#include <pthread.h>
#endif

namespace torchdof {
namespace {

struct Task {
  const std::function<void(int, int)> *body;
  const volatile int *cancelled;
  int count;
  std::atomic<int> next{0}, workers{0};
  int helping = 0;  // guarded by the pool's mutex, like error
  std::exception_ptr error;

  // Takes indices until none is left.
  std::exception_ptr work() {
    const int worker = workers++;
    try {
      for (int i; (i = next++) < count;) {
        if (cancelled && __atomic_load_n(cancelled, __ATOMIC_RELAXED)) throw Cancelled();
        (*body)(i, worker);
      }
    } catch (...) {
      next = count;
      return std::current_exception();
    }
    return nullptr;
  }
};

class Pool {
 public:
  void run(Task &task, int helpers) {
    {
      std::lock_guard<std::mutex> lock(mutex_);
      while (size_ < helpers) {
        std::thread(&Pool::serve, this).detach();
        size_++;
      }
      for (int i = 0; i < helpers; i++) wanted_.push_back(&task);
    }
    if (helpers) wake_.notify_all();
    std::exception_ptr error = task.work();
    std::unique_lock<std::mutex> lock(mutex_);
    for (auto i = wanted_.begin(); i != wanted_.end();) i = *i == &task ? wanted_.erase(i) : i + 1;
    done_.wait(lock, [&] { return task.helping == 0; });
    if (!error) error = task.error;
    lock.unlock();
    if (error) std::rethrow_exception(error);
  }

 private:
  void serve() {
    std::unique_lock<std::mutex> lock(mutex_);
    for (;;) {
      wake_.wait(lock, [&] { return !wanted_.empty(); });
      Task *task = wanted_.front();
      wanted_.pop_front();
      task->helping++;
      lock.unlock();
      std::exception_ptr error = task->work();
      lock.lock();
      if (error && !task->error) task->error = error;
      if (--task->helping == 0) done_.notify_all();
    }
  }

  std::mutex mutex_;
  std::condition_variable wake_, done_;
  std::deque<Task *> wanted_;
  int size_ = 0;
};

// Never destroyed: its threads wait until the process ends. A forked child has no threads and makes a new pool.
std::atomic<Pool *> the_pool{nullptr};

Pool &pool() {
  Pool *pool = the_pool.load();
  if (!pool) {
    Pool *made = new Pool();
    if (the_pool.compare_exchange_strong(pool, made)) {
      pool = made;
#if !defined(_WIN32)
      static const int once = pthread_atfork(nullptr, nullptr, [] { the_pool = nullptr; });
      (void)once;
#endif
    } else {
      delete made;
    }
  }
  return *pool;
}

}  // namespace

void parallel(int threads, int count, const volatile int *cancelled, const std::function<void(int, int)> &body) {
  if (count <= 0) return;
  Task task;
  task.body = &body;
  task.cancelled = cancelled;
  task.count = count;
  pool().run(task, std::max(0, std::min(threads, count) - 1));
}

}  // namespace torchdof
