/* Loaded before libc into a User Mode Linux kernel: the disk that CACHED names has a volatile write cache. What a write
   replaces is appended to the file CACHED.before, which is emptied when the guest asks for a flush: what stands in it
   when the plug is pulled goes back to the disk (tests/machine/uml.py). A record: offset and size, 8 bytes each, then the
   bytes that stood there. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

#define MOST (4 << 20)
#define ASKED 64 /* so many requests at once */

static int before = -1;
static struct stat disk;
static pid_t kernel;

__attribute__((constructor)) static void begin(void)
{
	char path[4096];
	const char *cached = getenv("CACHED");
	if (!cached || stat(cached, &disk) || snprintf(path, sizeof path, "%s.before", cached) >= (int)sizeof path)
		return;
	kernel = getpid();
	before = open(path, O_WRONLY | O_CREAT | O_TRUNC | O_APPEND | O_CLOEXEC, 0600);
}

static int is_cached(int fd)
{
	struct stat found;
	return before >= 0 && !fstat(fd, &found) && found.st_ino == disk.st_ino && found.st_dev == disk.st_dev;
}

ssize_t pwrite64(int fd, const void *data, size_t size, off64_t offset)
{
	static ssize_t (*next)(int, const void *, size_t, off64_t);
	static char old[MOST];
	if (!next)
		next = dlsym(RTLD_NEXT, "pwrite64");
	if (is_cached(fd)) {
		uint64_t head[2] = {offset, size};
		struct iovec record[2] = {{head, sizeof head}, {old, size}};
		if (size > MOST || pread64(fd, old, size, offset) != (ssize_t)size ||
		    writev(before, record, 2) != (ssize_t)(sizeof head + size))
			abort();
	}
	return next(fd, data, size, offset);
}

/* The thread for disks, a process, takes pointers to requests from a pipe. In Linux 6.1 (arch/um/drivers/ubd_kern.c) it does
   nothing for a flush, which has no descriptors: it is seen here, before the requests that came with it are done. What was
   done earlier is on the disk then. */
struct io_thread_req {
	void *request;
	int fds[2];
	unsigned long offsets[2];
	unsigned long long offset;
	int sectorsize, error, descriptors;
};

ssize_t read(int fd, void *data, size_t size)
{
	static ssize_t (*next)(int, void *, size_t);
	struct io_thread_req **taken = data;
	if (!next)
		next = dlsym(RTLD_NEXT, "read");
	ssize_t got = next(fd, data, size);
	if (before >= 0 && size == ASKED * sizeof *taken && got > 0 && getpid() != kernel)
		for (size_t i = 0; i < got / sizeof *taken; i++)
			if (!taken[i]->descriptors && is_cached(taken[i]->fds[0]) && ftruncate(before, 0))
				abort();
	return got;
}
