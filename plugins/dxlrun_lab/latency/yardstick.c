/* Yardstick of `dxlrun latency`: latency of a minimal program that sleeps until each deadline.
 *
 * Arguments: descriptor of the shared memory, number of wake-ups, period in ns, 1 to lock memory. The process that
 * executes this program has set policy, priority, cores and timer slack. buffer.py defines the shared memory. The
 * program uses clock_nanosleep with absolute times, as cyclictest does (rt-tests). */
#define _GNU_SOURCE
#include <errno.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <time.h>

enum { DONE, STOP, CPU_NS, WALL_NS, WAKE_UPS = 8 };

static int64_t now_ns(clockid_t clock)
{
    struct timespec now;
    clock_gettime(clock, &now);
    return (int64_t)now.tv_sec * 1000000000 + now.tv_nsec;
}

int main(int argc, char **argv)
{
    if (argc != 5)
        return 2;
    const int descriptor = atoi(argv[1]);
    const int64_t iterations = atoll(argv[2]), period_ns = atoll(argv[3]);
    struct stat file;
    if (fstat(descriptor, &file))
        return 1;
    const size_t size = (size_t)file.st_size;
    volatile int64_t *const words = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED, descriptor, 0);
    if (words == MAP_FAILED)
        return 1;
    if (atoi(argv[4]) && mlockall(MCL_CURRENT | MCL_FUTURE))
        return 3;
    for (size_t word = 0; word < size / sizeof *words; word += 512)
        words[word] = words[word];
    const int64_t cpu_ns = now_ns(CLOCK_PROCESS_CPUTIME_ID), begin_ns = now_ns(CLOCK_MONOTONIC);
    int64_t deadline_ns = begin_ns + period_ns;
    for (int64_t done = 0; done < iterations && !words[STOP]; deadline_ns += period_ns) {
        const int64_t passed_ns = now_ns(CLOCK_MONOTONIC) - deadline_ns;
        if (passed_ns > 0) /* skip all missed periods in one step, as the loop does */
            deadline_ns += (passed_ns + period_ns - 1) / period_ns * period_ns;
        const struct timespec deadline = {deadline_ns / 1000000000, deadline_ns % 1000000000};
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &deadline, NULL) == EINTR)
            ;
        words[WAKE_UPS + 2 * done + 1] = now_ns(CLOCK_MONOTONIC);
        words[WAKE_UPS + 2 * done] = deadline_ns;
        done++;
        __atomic_store_n(&words[DONE], done, __ATOMIC_RELEASE); /* readers see both times first */
    }
    if (iterations) {
        words[CPU_NS] = now_ns(CLOCK_PROCESS_CPUTIME_ID) - cpu_ns;
        words[WALL_NS] = now_ns(CLOCK_MONOTONIC) - begin_ns;
    }
    return 0;
}
