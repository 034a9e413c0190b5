/* SPDX-License-Identifier: Apache-2.0
 *
 * A disk that fails: `disk_fails` makes the Nth call that changes files below a folder fail, as SQLite's own tests do.
 * Preloaded, it stands between the C library and everything in the process: Python, SQLite, MCAP, Pillow.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/types.h>
#include <unistd.h>

enum { WRITE, SYNC, RENAME, OPEN, MKDIR, KINDS };

static char folder[PATH_MAX];
static int failing = -1, error, persists;
static long left, counts[KINDS];
static pthread_mutex_t lock = PTHREAD_MUTEX_INITIALIZER;

/* Arms the disk: the call number `nth` of `kind` fails with `number`, 0 for a short write, and so do all later ones of
 * a disk that stays full (`stays`). */
void disk_fails(const char *below, int kind, long nth, int number, int stays) {
    snprintf(folder, sizeof folder, "%s", below);
    failing = kind, left = nth, error = number, persists = stays;
    memset(counts, 0, sizeof counts);
}

long disk_calls(int kind) { return counts[kind]; }

static int below(const char *path) {
    char whole[2 * PATH_MAX], here[PATH_MAX];
    if (!folder[0] || !path) return 0;
    if (path[0] != '/' && getcwd(here, sizeof here)) {
        snprintf(whole, sizeof whole, "%s/%s", here, path);
        path = whole;
    }
    size_t length = strlen(folder);
    return strncmp(path, folder, length) == 0 && (path[length] == '/' || !path[length]);
}

static int below_fd(int file) {
    char link[64], path[PATH_MAX];
    if (!folder[0]) return 0;
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return below(path);
}

/* Whether this call is the one that fails. */
static int fails(int kind) {
    pthread_mutex_lock(&lock);
    counts[kind]++;
    int now = kind == failing && (--left == 0 || (persists && left < 0));
    pthread_mutex_unlock(&lock);
    if (now) errno = error;
    return now;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define WRITES(name, parameters, arguments)                          \
    ssize_t name parameters {                                        \
        if (below_fd(file) && fails(WRITE)) {                        \
            if (error) return -1;                                    \
            size /= 2;                                               \
        }                                                            \
        return REAL(name) arguments;                                 \
    }
WRITES(write, (int file, const void *data, size_t size), (file, data, size))
WRITES(pwrite, (int file, const void *data, size_t size, off_t at), (file, data, size, at))
WRITES(pwrite64, (int file, const void *data, size_t size, off64_t at), (file, data, size, at))

#define CALL(name, kind, test, parameters, arguments)                \
    int name parameters {                                            \
        if (test && fails(kind)) return -1;                          \
        return REAL(name) arguments;                                 \
    }
CALL(ftruncate, WRITE, below_fd(file), (int file, off_t size), (file, size))
CALL(ftruncate64, WRITE, below_fd(file), (int file, off64_t size), (file, size))
CALL(fsync, SYNC, below_fd(file), (int file), (file))
CALL(fdatasync, SYNC, below_fd(file), (int file), (file))
CALL(rename, RENAME, below(to), (const char *from, const char *to), (from, to))
CALL(mkdir, MKDIR, below(path), (const char *path, mode_t mode), (path, mode))

#define OPENS(name, parameters, arguments)                           \
    int name parameters {                                            \
        mode_t mode = 0;                                             \
        if (flags & O_CREAT) {                                       \
            va_list rest;                                            \
            va_start(rest, flags);                                   \
            mode = va_arg(rest, mode_t);                             \
            va_end(rest);                                            \
        }                                                            \
        if (flags & (O_CREAT | O_WRONLY | O_RDWR) && below(path) && fails(OPEN)) return -1; \
        return REAL(name) arguments;                                 \
    }
OPENS(open, (const char *path, int flags, ...), (path, flags, mode))
OPENS(open64, (const char *path, int flags, ...), (path, flags, mode))
OPENS(openat, (int base, const char *path, int flags, ...), (base, path, flags, mode))
OPENS(openat64, (int base, const char *path, int flags, ...), (base, path, flags, mode))

FILE *fopen64(const char *path, const char *mode) {
    if (!strchr(mode, 'r') && below(path) && fails(OPEN)) return NULL;
    return REAL(fopen64)(path, mode);
}
