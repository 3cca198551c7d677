/* Makes Debian's User-Mode Linux run on processors whose register state has grown since it was built.
 *
 * The kernel keeps its processes' extended registers in a buffer of the size that it knew at build time
 * and writes them back with PTRACE_SETREGSET(NT_X86_XSTATE). A host with AMX has a larger state and
 * refuses a shorter one (EFAULT), which the guest takes for a reason to panic. This library, preloaded
 * into linux.uml, reads the full state first and replaces its beginning by what the guest gave.
 *
 *     gcc -O2 -shared -fPIC -o uml-xstate.so uml-xstate.c -ldl
 *     LD_PRELOAD=$PWD/uml-xstate.so linux.uml ...
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdarg.h>
#include <string.h>
#include <sys/ptrace.h>
#include <sys/types.h>
#include <sys/uio.h>

#define NT_X86_XSTATE 0x202

long ptrace(enum __ptrace_request request, ...)
{
    static long (*next)(enum __ptrace_request, pid_t, void *, void *);
    static __thread char full[65536] __attribute__((aligned(64)));

    va_list arguments;
    va_start(arguments, request);
    pid_t pid = va_arg(arguments, pid_t);
    void *address = va_arg(arguments, void *);
    void *data = va_arg(arguments, void *);
    va_end(arguments);

    if (!next)
        next = (long (*)(enum __ptrace_request, pid_t, void *, void *))dlsym(RTLD_NEXT, "ptrace");
    if (request == PTRACE_SETREGSET && (unsigned long)address == NT_X86_XSTATE) {
        const struct iovec *given = data;
        struct iovec whole = {full, sizeof full};
        if (next(PTRACE_GETREGSET, pid, address, &whole) == 0 && whole.iov_len > given->iov_len) {
            memcpy(full, given->iov_base, given->iov_len);
            return next(request, pid, address, &whole);
        }
    }
    return next(request, pid, address, data);
}
