/* SPDX-License-Identifier: Apache-2.0
 *
 * A disk that fails at the Nth call that changes files below a folder, as SQLite's own tests have it, and that keeps a
 * record of what reaches it, from which the states after a power cut are made.
 *
 * Preloaded, it stands between the C library and everything in a process: Python, SQLite, MCAP, Pillow. What it does
 * is in the file that DISK_STATE names, which all processes share; `disk.py` writes it.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/syscall.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

enum { WRITE, SYNC, RENAME, OPEN, MKDIR, KINDS, TRUNCATE = KINDS, UNLINK, RMDIR };

/* As `State` in disk.py. An `error` of 0 is a short write; what `stays` fails from the Nth call on. */
static struct state {
    char folder[1024], record[1024];
    int kind, error, stays, lock;
    long nth, counts[KINDS];
} *disk;

__attribute__((constructor)) static void start(void) {
    const char *path = getenv("DISK_STATE");
    int file = path ? (int)syscall(SYS_openat, AT_FDCWD, path, O_RDWR | O_CLOEXEC) : -1;
    void *shared = file < 0 ? MAP_FAILED : mmap(NULL, sizeof *disk, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    if (shared != MAP_FAILED) disk = shared;
    if (file >= 0) syscall(SYS_close, file);
}

/* Where a file lies, or NULL if that is not below the folder. */
static const char *below(int base, const char *path, char *whole) {
    char link[64];
    if (!disk || !disk->folder[0] || !path) return NULL;
    ssize_t length = 0;
    if (path[0] != '/') {
        if (base == AT_FDCWD) snprintf(link, sizeof link, "/proc/self/cwd");
        else snprintf(link, sizeof link, "/proc/self/fd/%d", base);
        length = readlink(link, whole, PATH_MAX - 1);
        if (length < 0) return NULL;
    }
    snprintf(whole + length, PATH_MAX - length, "%s%s", length && path[0] ? "/" : "", path);
    size_t folder = strlen(disk->folder);
    return strncmp(whole, disk->folder, folder) == 0 && (whole[folder] == '/' || !whole[folder]) ? whole : NULL;
}

/* Counts a call, and says whether it is one that fails. */
static int fails(int kind) {
    long now = __atomic_add_fetch(&disk->counts[kind], 1, __ATOMIC_SEQ_CST);
    if (kind != disk->kind || !(now == disk->nth || (disk->stays && now > disk->nth))) return 0;
    errno = disk->error;
    return 1;
}

static void take(void) { while (__atomic_exchange_n(&disk->lock, 1, __ATOMIC_SEQ_CST)) usleep(50); }
static void give(void) { __atomic_store_n(&disk->lock, 0, __ATOMIC_SEQ_CST); }

/* Appends a call that succeeded to the record, which `power_cut.py` reads. */
static void record(int kind, const char *path, const char *to, long at, const void *data, size_t size) {
    int before = errno, file = (int)syscall(SYS_openat, AT_FDCWD, disk->record, O_WRONLY | O_APPEND | O_CLOEXEC);
    long header[] = {kind, (long)strlen(path), (long)strlen(to), at, (long)size};
    struct iovec parts[] = {
        {header, sizeof header}, {(void *)path, header[1]}, {(void *)to, header[2]}, {(void *)data, size},
    };
    if (file < 0 || syscall(SYS_writev, file, parts, 4) < 0) abort();
    syscall(SYS_close, file);
    errno = before;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define IN_TURN(call, after)                                         \
    if (disk && disk->record[0] && path) {                           \
        take();                                                      \
        __typeof__(call) done = call;                                \
        after;                                                       \
        give();                                                      \
        return done;                                                 \
    }                                                                \
    return call

#define WRITES(name, parameters, arguments, place)                   \
    ssize_t name parameters {                                        \
        char whole[PATH_MAX];                                        \
        const char *path = below(file, "", whole);                   \
        if (path && fails(WRITE)) {                                  \
            if (disk->error) return -1;                              \
            size /= 2;                                               \
        }                                                            \
        IN_TURN(REAL(name) arguments, if (done > 0) record(WRITE, path, "", place, data, done)); \
    }
WRITES(write, (int file, const void *data, size_t size), (file, data, size), lseek(file, 0, SEEK_CUR) - done)
WRITES(pwrite, (int file, const void *data, size_t size, off_t at), (file, data, size, at), at)
WRITES(pwrite64, (int file, const void *data, size_t size, off64_t at), (file, data, size, at), at)

#define CALL(name, kind, base, where, parameters, arguments, test, after) \
    int name parameters {                                            \
        char whole[PATH_MAX];                                        \
        const char *path = below(base, where, whole);                \
        if (path && test) return -1;                                 \
        IN_TURN(REAL(name) arguments, if (!done) after);             \
    }
#define RECORD(kind, at) record(kind, path, "", at, "", 0)
CALL(ftruncate, WRITE, file, "", (int file, off_t size), (file, size), fails(WRITE), RECORD(TRUNCATE, size))
CALL(ftruncate64, WRITE, file, "", (int file, off64_t size), (file, size), fails(WRITE), RECORD(TRUNCATE, size))
CALL(fsync, SYNC, file, "", (int file), (file), fails(SYNC), RECORD(SYNC, 0))
CALL(fdatasync, SYNC, file, "", (int file), (file), fails(SYNC), RECORD(SYNC, 0))
CALL(mkdir, MKDIR, AT_FDCWD, name, (const char *name, mode_t mode), (name, mode), fails(MKDIR), RECORD(MKDIR, 0))
CALL(unlink, UNLINK, AT_FDCWD, name, (const char *name), (name), 0, RECORD(UNLINK, 0))
CALL(unlinkat, UNLINK, base, name, (int base, const char *name, int flags), (base, name, flags), 0,
     RECORD(flags & AT_REMOVEDIR ? RMDIR : UNLINK, 0))
CALL(rmdir, RMDIR, AT_FDCWD, name, (const char *name), (name), 0, RECORD(RMDIR, 0))

int rename(const char *from, const char *to) {
    char source[PATH_MAX], target[PATH_MAX];
    const char *origin = below(AT_FDCWD, from, source), *path = below(AT_FDCWD, to, target);
    if (path && fails(RENAME)) return -1;
    IN_TURN(REAL(rename)(from, to), if (!done && origin) record(RENAME, origin, path, 0, "", 0));
}

#define OPENS(name, base, parameters, arguments)                     \
    int name parameters {                                            \
        char whole[PATH_MAX];                                        \
        mode_t mode = 0;                                             \
        if (flags & O_CREAT) {                                       \
            va_list rest;                                            \
            va_start(rest, flags);                                   \
            mode = va_arg(rest, mode_t);                             \
            va_end(rest);                                            \
        }                                                            \
        const char *path = flags & (O_CREAT | O_WRONLY | O_RDWR) ? below(base, file, whole) : NULL; \
        if (path && fails(OPEN)) return -1;                          \
        IN_TURN(REAL(name) arguments, if (done >= 0 && flags & (O_CREAT | O_TRUNC)) RECORD(OPEN, flags & O_TRUNC)); \
    }
OPENS(open, AT_FDCWD, (const char *file, int flags, ...), (file, flags, mode))
OPENS(open64, AT_FDCWD, (const char *file, int flags, ...), (file, flags, mode))
OPENS(openat, base, (int base, const char *file, int flags, ...), (base, file, flags, mode))
OPENS(openat64, base, (int base, const char *file, int flags, ...), (base, file, flags, mode))

FILE *fopen64(const char *file, const char *mode) {
    char whole[PATH_MAX];
    const char *path = strchr(mode, 'r') ? NULL : below(AT_FDCWD, file, whole);
    if (path && fails(OPEN)) return NULL;
    return REAL(fopen64)(file, mode);
}
