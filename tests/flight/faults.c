/* A library for LD_PRELOAD that lets one call of a process fail, Python's and SQLite's alike.

   Calls that change or make sure files below `root` are counted. `faults_arm(n, error, lasting)` lets the n-th of them
   fail with this errno, and with `lasting` all that follow; `faults_count()` is how many there were. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static char root[4096];
static long at, count;
static int error_no, for_ever;

void faults_root(const char *path) { snprintf(root, sizeof root, "%s", path); }
void faults_arm(long n, int error, int lasting) { at = n; error_no = error; for_ever = lasting; count = 0; }
long faults_count(void) { return count; }

static int below(const char *path) { return root[0] && strncmp(path, root, strlen(root)) == 0; }

static int below_fd(int fd) {
    char link[64], path[4096];
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    if (length < 0) return 0;
    path[length] = 0;
    return below(path);
}

static int below_at(int fd, const char *path) { return path[0] == '/' || fd == AT_FDCWD ? below(path) : below_fd(fd); }

/* whether this call is the one that fails */
static int fails(int ours) {
    if (!ours) return 0;
    count++;
    if (at == 0 || count < at || (count > at && !for_ever)) return 0;
    errno = error_no;
    return 1;
}

#define REAL(name) static __typeof__(name) *real; if (!real) real = (__typeof__(name) *)dlsym(RTLD_NEXT, #name)
#define MODE(flags) mode_t mode = 0; if ((flags) & (O_CREAT | O_TMPFILE)) { va_list v; va_start(v, flags); mode = va_arg(v, mode_t); va_end(v); }

int open(const char *p, int f, ...) { REAL(open); MODE(f) return fails(below(p)) ? -1 : real(p, f, mode); }
int open64(const char *p, int f, ...) { REAL(open64); MODE(f) return fails(below(p)) ? -1 : real(p, f, mode); }
int openat(int d, const char *p, int f, ...) { REAL(openat); MODE(f) return fails(below_at(d, p)) ? -1 : real(d, p, f, mode); }
int openat64(int d, const char *p, int f, ...) { REAL(openat64); MODE(f) return fails(below_at(d, p)) ? -1 : real(d, p, f, mode); }
ssize_t write(int d, const void *b, size_t n) { REAL(write); return fails(below_fd(d)) ? -1 : real(d, b, n); }
ssize_t pwrite(int d, const void *b, size_t n, off_t o) { REAL(pwrite); return fails(below_fd(d)) ? -1 : real(d, b, n, o); }
ssize_t pwrite64(int d, const void *b, size_t n, off64_t o) { REAL(pwrite64); return fails(below_fd(d)) ? -1 : real(d, b, n, o); }
int fsync(int d) { REAL(fsync); return fails(below_fd(d)) ? -1 : real(d); }
int fdatasync(int d) { REAL(fdatasync); return fails(below_fd(d)) ? -1 : real(d); }
int ftruncate(int d, off_t n) { REAL(ftruncate); return fails(below_fd(d)) ? -1 : real(d, n); }
int ftruncate64(int d, off64_t n) { REAL(ftruncate64); return fails(below_fd(d)) ? -1 : real(d, n); }
int rename(const char *a, const char *b) { REAL(rename); return fails(below(b)) ? -1 : real(a, b); }
int renameat(int c, const char *a, int d, const char *b) { REAL(renameat); return fails(below_at(d, b)) ? -1 : real(c, a, d, b); }
int unlink(const char *p) { REAL(unlink); return fails(below(p)) ? -1 : real(p); }
int unlinkat(int d, const char *p, int f) { REAL(unlinkat); return fails(below_at(d, p)) ? -1 : real(d, p, f); }
int mkdir(const char *p, mode_t m) { REAL(mkdir); return fails(below(p)) ? -1 : real(p, m); }
int mkdirat(int d, const char *p, mode_t m) { REAL(mkdirat); return fails(below_at(d, p)) ? -1 : real(d, p, m); }
