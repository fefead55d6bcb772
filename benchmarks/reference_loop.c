/* A 1 kHz loop that does nothing: sleeps until 200 us before its tick, spins the rest, notes how late it is.
   What the machine does to the best loop there is. Usage: reference_loop SECONDS; prints lateness in us, one a line. */

#define _GNU_SOURCE
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <time.h>

static long long now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

int main(int count, char **arguments)
{
    int ticks = count > 1 ? (int)(1000.0 * atof(arguments[1])) : 1000;
    struct sched_param policy = {.sched_priority = 80};
    mlockall(MCL_CURRENT | MCL_FUTURE);
    sched_setscheduler(0, SCHED_FIFO, &policy);
    double *late = calloc(ticks, sizeof(double));
    long long due = now_ns() + 1000000;
    for (int k = 0; k < ticks; k++, due += 1000000) {
        long long wake = due - 200000;
        struct timespec t = {wake / 1000000000LL, wake % 1000000000LL};
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
        while (now_ns() < due) {}
        late[k] = 1e-3 * (double)(now_ns() - due);
    }
    for (int k = 0; k < ticks; k++) printf("%.1f\n", late[k]);
    return 0;
}
