/* Loaded before libc into a User Mode Linux kernel: since Linux 6.1 was written, processors have got more registers than the
   2696 bytes in which it keeps a process' (AMX: 11008), and the host takes them back as a whole only. No guest uses those
   that are missing here: they go back as they are in a new process, at rest. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <elf.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/uio.h>

#define MOST 65536

static size_t whole; /* of the host's set */

long ptrace(enum __ptrace_request request, ...)
{
	static long (*next)(enum __ptrace_request, ...);
	static char all[MOST] __attribute__((aligned(64)));
	va_list arguments;
	va_start(arguments, request);
	int pid = va_arg(arguments, int);
	void *address = va_arg(arguments, void *), *data = va_arg(arguments, void *);
	va_end(arguments);
	if (!next)
		next = dlsym(RTLD_NEXT, "ptrace");
	if ((long)address != NT_X86_XSTATE || (request != PTRACE_GETREGSET && request != PTRACE_SETREGSET))
		return next(request, pid, address, data);
	struct iovec *asked = data, ours = {all, whole ? whole : MOST};
	if (request == PTRACE_GETREGSET || !whole) {
		if (next(PTRACE_GETREGSET, pid, address, &ours) < 0)
			return -1;
		whole = ours.iov_len;
		if (asked->iov_len > whole)
			asked->iov_len = whole;
		if (request == PTRACE_GETREGSET) {
			memcpy(asked->iov_base, all, asked->iov_len);
			return 0;
		}
	}
	size_t known = asked->iov_len < whole ? asked->iov_len : whole;
	memset(all, 0, whole);
	memcpy(all, asked->iov_base, known);
	if (known < whole) /* the header says which are not at rest: bits 16 to 23 are AMX's and later ones */
		((unsigned char *)all)[514] = 0;
	return next(PTRACE_SETREGSET, pid, address, &ours);
}
