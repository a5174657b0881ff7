"""An executor: threads of this process."""

from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.thread import BrokenThreadPool


class ThreadPool:
    death = BrokenThreadPool
    most_deaths = 1

    def __init__(self, count):
        self.capacity = count
        self._threads = ThreadPoolExecutor(count)

    def submit(self, function, arguments):
        return self._threads.submit(function, *arguments)

    def abandon_tasks(self):
        """Cancel the waiting tasks; a thread cannot be stopped, so running tasks finish unnoticed."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        self._threads = ThreadPoolExecutor(self.capacity)

    def close(self):
        self._threads.shutdown()


def open_thread_pool(workers):
    return ThreadPool(workers.count)
