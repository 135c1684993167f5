/* Counts the system calls of a process and its children that change files below a folder; kills or stops it before one of them, and
 * writes down what each of them does, so that any state of the disc can be made again.
 *
 * Loaded with LD_PRELOAD. Environment: UMOV_DISC_FOLDER, and UMOV_DISC_LOG for the record. Functions for the program
 * itself: disc_calls_arm(n, signal, m) sends the signal before the n-th call from now on, and lets the m-th fail if it
 * is a write, a sync or the like (0 for never); disc_calls_made() counts; disc_calls_note(text) adds a remark to the
 * record.
 *
 * A record is a line "call number path offset length", and after it the bytes of a write.
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <pthread.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

/* Shared by a program and the children that it forks: they count together, and end or stop together. */
#define MOST 16
static struct {
    pthread_mutex_t lock;
    long made, armed, to_fail;
    int armed_signal, processes;
    pid_t pids[MOST];
} *all;
/* Set when the call that is being made is to fail with an input/output error. */
static __thread int failing;
static int record = -2;

static void forked(void) {
    record = -2;
    int number = __atomic_fetch_add(&all->processes, 1, __ATOMIC_SEQ_CST);
    if (number < MOST) all->pids[number] = getpid();
}

static void count_anew(void) {
    all = mmap(NULL, sizeof *all, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    pthread_mutexattr_t kind;
    pthread_mutexattr_init(&kind);
    pthread_mutexattr_settype(&kind, PTHREAD_MUTEX_RECURSIVE);
    pthread_mutexattr_setpshared(&kind, PTHREAD_PROCESS_SHARED);
    pthread_mutex_init(&all->lock, &kind);
    all->processes = 1;
    all->pids[0] = getpid();
}

__attribute__((constructor)) static void begin(void) {
    count_anew();
    pthread_atfork(NULL, NULL, forked);
}

#define REAL(name, type) static __typeof__(type) real; if (!real) real = (__typeof__(type))dlsym(RTLD_NEXT, name)

static const char *folder(void) { return getenv("UMOV_DISC_FOLDER"); }

static ssize_t plain_write(int fd, const void *data, size_t size) {
    REAL("write", ssize_t (*)(int, const void *, size_t));
    return real(fd, data, size);
}

static int watched_path(const char *path) {
    const char *where = folder();
    return where && path && strncmp(path, where, strlen(where)) == 0;
}

static int path_of(int fd, char *path) {
    char link[64];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t size = readlink(link, path, PATH_MAX - 1);
    if (size < 0) return 0;
    path[size] = 0;
    return watched_path(path);
}

static void absolute(int at, const char *path, char *out) {
    if (path[0] == '/') { snprintf(out, PATH_MAX, "%s", path); return; }
    char base[PATH_MAX];
    if (at == AT_FDCWD) { if (!getcwd(base, sizeof base)) base[0] = 0; }
    else { char link[64]; snprintf(link, sizeof link, "/proc/self/fd/%d", at);
           ssize_t n = readlink(link, base, PATH_MAX - 1); base[n > 0 ? n : 0] = 0; }
    snprintf(out, PATH_MAX, "%s/%s", base, path);
}

static void put(const char *call, const char *path, long offset, const void *data, size_t size) {
    if (record == -2) {
        const char *log = getenv("UMOV_DISC_LOG");
        REAL("open", int (*)(const char *, int, ...));
        record = log ? real(log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0600) : -1;
    }
    if (record < 0) return;
    char line[PATH_MAX + 100];
    int length = snprintf(line, sizeof line, "%s\t%s\t%ld\t%zu\n", call, path, offset, size);
    plain_write(record, line, length);
    if (data) plain_write(record, data, size);
}

/* Before a call that changes the disc. */
static void before(const char *call, const char *path, long offset, const void *data, size_t size) {
    all->made++;
    if (all->to_fail && all->made == all->to_fail) { failing = 1; return; }
    if (all->armed && all->made == all->armed) {
        for (int k = 0; k < all->processes && k < MOST; k++)
            if (all->pids[k] != getpid()) kill(all->pids[k], all->armed_signal);
        kill(getpid(), all->armed_signal);
        /* A signal to the process may take a moment to arrive at this thread. */
        while (all->armed_signal == SIGKILL) pause();
    }
    put(call, path, offset, data, size);
}

static int failed(void) {
    if (!failing) return 0;
    failing = 0;
    errno = EIO;
    return 1;
}

#define LOCKED(work) pthread_mutex_lock(&all->lock); work; pthread_mutex_unlock(&all->lock)

void disc_calls_arm(long n, int number, long fails) {
    count_anew();
    all->armed = n;
    all->armed_signal = number;
    all->to_fail = fails;
}
long disc_calls_made(void) { return all->made; }
void disc_calls_note(const char *text) { LOCKED(put("note", text, 0, NULL, 0)); }

static int opened(const char *name, int at, const char *path, int flags, mode_t mode) {
    REAL("openat", int (*)(int, const char *, int, ...));
    char whole[PATH_MAX];
    if (!path || !(flags & (O_CREAT | O_TRUNC))) return real(at, path, flags, mode);
    absolute(at, path, whole);
    if (!watched_path(whole)) return real(at, path, flags, mode);
    (void)name;
    int fd;
    LOCKED(before(flags & O_TRUNC ? "create" : "open", whole, 0, NULL, 0); fd = real(at, path, flags, mode));
    return fd;
}

#define MODE(flags) mode_t mode = 0; if ((flags) & (O_CREAT | O_TMPFILE)) { va_list rest; va_start(rest, flags); mode = va_arg(rest, mode_t); va_end(rest); }
int open(const char *path, int flags, ...) { MODE(flags) return opened("open", AT_FDCWD, path, flags, mode); }
int open64(const char *path, int flags, ...) { MODE(flags) return opened("open64", AT_FDCWD, path, flags, mode); }
int openat(int at, const char *path, int flags, ...) { MODE(flags) return opened("openat", at, path, flags, mode); }
int openat64(int at, const char *path, int flags, ...) { MODE(flags) return opened("openat64", at, path, flags, mode); }
int creat(const char *path, mode_t mode) { return opened("creat", AT_FDCWD, path, O_CREAT | O_WRONLY | O_TRUNC, mode); }

#define ON_FD(fd, call, offset, data, size, expression) \
    char path[PATH_MAX]; \
    if (!folder() || !path_of(fd, path)) return expression; \
    ssize_t result; \
    LOCKED(before(call, path, offset, data, size); result = failed() ? -1 : expression); \
    return result

ssize_t write(int fd, const void *data, size_t size) {
    REAL("write", ssize_t (*)(int, const void *, size_t));
    off_t here = folder() ? lseek(fd, 0, SEEK_CUR) : 0;
    if (folder() && (fcntl(fd, F_GETFL) & O_APPEND)) { struct stat s; if (fstat(fd, &s) == 0) here = s.st_size; }
    ON_FD(fd, "write", here, data, size, real(fd, data, size));
}
ssize_t pwrite(int fd, const void *data, size_t size, off_t offset) {
    REAL("pwrite", ssize_t (*)(int, const void *, size_t, off_t));
    ON_FD(fd, "write", offset, data, size, real(fd, data, size, offset));
}
ssize_t pwrite64(int fd, const void *data, size_t size, off64_t offset) {
    REAL("pwrite64", ssize_t (*)(int, const void *, size_t, off64_t));
    ON_FD(fd, "write", offset, data, size, real(fd, data, size, offset));
}
int fsync(int fd) { REAL("fsync", int (*)(int)); ON_FD(fd, "sync", 0, NULL, 0, real(fd)); }
int fdatasync(int fd) { REAL("fdatasync", int (*)(int)); ON_FD(fd, "sync", 0, NULL, 0, real(fd)); }
int ftruncate(int fd, off_t size) { REAL("ftruncate", int (*)(int, off_t)); ON_FD(fd, "truncate", size, NULL, 0, real(fd, size)); }
int ftruncate64(int fd, off64_t size) { REAL("ftruncate64", int (*)(int, off64_t)); ON_FD(fd, "truncate", size, NULL, 0, real(fd, size)); }
int posix_fallocate(int fd, off_t offset, off_t size) {
    REAL("posix_fallocate", int (*)(int, off_t, off_t));
    ON_FD(fd, "allocate", offset + size, NULL, 0, real(fd, offset, size));
}
int posix_fallocate64(int fd, off64_t offset, off64_t size) {
    REAL("posix_fallocate64", int (*)(int, off64_t, off64_t));
    ON_FD(fd, "allocate", offset + size, NULL, 0, real(fd, offset, size));
}

static int renamed(int from_at, const char *from, int to_at, const char *to) {
    REAL("renameat", int (*)(int, const char *, int, const char *));
    char a[PATH_MAX], b[PATH_MAX];
    absolute(from_at, from, a);
    absolute(to_at, to, b);
    if (!watched_path(a)) return real(from_at, from, to_at, to);
    int result;
    LOCKED(before("rename", a, 0, b, strlen(b)); result = real(from_at, from, to_at, to));
    return result;
}
int rename(const char *from, const char *to) { return renamed(AT_FDCWD, from, AT_FDCWD, to); }
int renameat(int a, const char *from, int b, const char *to) { return renamed(a, from, b, to); }
int renameat2(int a, const char *from, int b, const char *to, unsigned int flags) { (void)flags; return renamed(a, from, b, to); }

#define ON_PATH(call, at, path, expression) \
    char whole[PATH_MAX]; \
    absolute(at, path, whole); \
    if (!watched_path(whole)) return expression; \
    int result; \
    LOCKED(before(call, whole, 0, NULL, 0); result = expression); \
    return result

int unlink(const char *path) { REAL("unlink", int (*)(const char *)); ON_PATH("unlink", AT_FDCWD, path, real(path)); }
int unlinkat(int at, const char *path, int flags) { REAL("unlinkat", int (*)(int, const char *, int)); ON_PATH("unlink", at, path, real(at, path, flags)); }
int mkdir(const char *path, mode_t mode) { REAL("mkdir", int (*)(const char *, mode_t)); ON_PATH("mkdir", AT_FDCWD, path, real(path, mode)); }
int mkdirat(int at, const char *path, mode_t mode) { REAL("mkdirat", int (*)(int, const char *, mode_t)); ON_PATH("mkdir", at, path, real(at, path, mode)); }
