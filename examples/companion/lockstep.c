/* A clock for Betaflight's SITL that stands still until the simulator allows the next step, so that
 * a flight does not depend on how busy the computer is. It is loaded with LD_PRELOAD.
 *
 * The firmware's main thread reads the time and sleeps in this clock. Pipe LOCKSTEP_GO brings how
 * many ns it may go on, and how many packets the firmware's other threads have to digest first;
 * a byte in pipe LOCKSTEP_DONE says that it has got there.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <pthread.h>
#include <stdint.h>
#include <stdlib.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#define PER_CALL 500 /* ns that pass when the firmware asks for the time */

static _Atomic uint64_t now = 1000000000;
static uint64_t allowed = 1000000000, expected, digested;
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t arrived = PTHREAD_COND_INITIALIZER;
static __thread int holds_packet;

static int is_main(void)
{
    static __thread int known;
    if (!known) {
        known = gettid() == getpid() ? 1 : 2;
    }
    return known == 1;
}

static int descriptor(const char *name)
{
    const char *number = getenv(name);
    return number ? atoi(number) : -1;
}

static void advance(uint64_t ns)
{
    static int go, done, waits;
    if (!go) {
        go = descriptor("LOCKSTEP_GO");
        done = descriptor("LOCKSTEP_DONE");
    }
    now += ns;
    while (now >= allowed) {
        uint64_t message[2];
        if (waits && write(done, "t", 1) != 1) {
            _exit(1);
        }
        waits = 1;
        if (read(go, message, sizeof message) != sizeof message) {
            _exit(0); /* the simulator has ended */
        }
        allowed += message[0];
        expected += message[1];
        pthread_mutex_lock(&lock);
        while (digested < expected) {
            pthread_cond_wait(&arrived, &lock);
        }
        pthread_mutex_unlock(&lock);
    }
}

int clock_gettime(clockid_t id, struct timespec *time)
{
    if (is_main()) {
        advance(PER_CALL);
    }
    (void)id;
    time->tv_sec = now / 1000000000;
    time->tv_nsec = now % 1000000000;
    return 0;
}

int nanosleep(const struct timespec *wanted, struct timespec *left)
{
    if (is_main()) {
        /* The main loop sleeps for 50 us to spare the computer; an 8 kHz gyro needs less. */
        int is_short = wanted->tv_sec == 0 && wanted->tv_nsec <= 50000;
        advance(is_short ? 5000 : 1000000000 * (uint64_t)wanted->tv_sec + wanted->tv_nsec);
        return 0;
    }
    int (*next)(const struct timespec *, struct timespec *) = dlsym(RTLD_NEXT, "nanosleep");
    return next(wanted, left);
}

ssize_t recvfrom(int fd, void *data, size_t size, int flags, struct sockaddr *from, socklen_t *n)
{
    ssize_t (*next)(int, void *, size_t, int, struct sockaddr *, socklen_t *);
    next = dlsym(RTLD_NEXT, "recvfrom");
    ssize_t got = next(fd, data, size, flags, from, n);
    holds_packet = got > 0;
    return got;
}

/* A thread that waits for the next packet has digested the one before. */
int select(int n, fd_set *in, fd_set *out, fd_set *except, struct timeval *timeout)
{
    if (holds_packet) {
        holds_packet = 0;
        pthread_mutex_lock(&lock);
        digested++;
        pthread_cond_signal(&arrived);
        pthread_mutex_unlock(&lock);
    }
    int (*next)(int, fd_set *, fd_set *, fd_set *, struct timeval *) = dlsym(RTLD_NEXT, "select");
    return next(n, in, out, except, timeout);
}

/* The firmware's thread for TCP forgets what the main thread has opened before it began. */
int pthread_create(pthread_t *thread, const pthread_attr_t *with, void *(*run)(void *), void *of)
{
    int (*next)(pthread_t *, const pthread_attr_t *, void *(*)(void *), void *);
    next = dlsym(RTLD_NEXT, "pthread_create");
    int result = next(thread, with, run, of);
    usleep(200000);
    return result;
}
