// A thread with its own stack, switched to in a few instructions, or more slowly on unknown architectures.
#pragma once

#include <stddef.h>

#include "cuda_on_cpu.h"

#if !defined(__x86_64__) || defined(HARNESS_PORTABLE)
#define HARNESS_UCONTEXT 1
#include <ucontext.h>
#endif

namespace harness {
namespace {

#if !HARNESS_UCONTEXT
// Pushes the callee-saved registers, and switches to the other stack.
extern "C" HARNESS_LOCAL void harness_switch(void** from, void* to);
asm(R"(
    .text
    .p2align 4
    .hidden harness_switch
    .globl harness_switch
    .type harness_switch, @function
harness_switch:
    pushq %rbp
    pushq %rbx
    pushq %r12
    pushq %r13
    pushq %r14
    pushq %r15
    movq %rsp, (%rdi)
    movq %rsi, %rsp
    popq %r15
    popq %r14
    popq %r13
    popq %r12
    popq %rbx
    popq %rbp
    ret
    .size harness_switch, .-harness_switch
)");

class Fiber {
  public:
    void start(char* stack, size_t bytes, void (*entry)()) {
        void** top = reinterpret_cast<void**>(stack + bytes);  // aligned to 16
        *--top = nullptr;                                      // where entry would return to
        *--top = reinterpret_cast<void*>(entry);
        for (int saved = 0; saved < 6; ++saved) *--top = nullptr;
        at_ = top;
    }
    void go_to(const Fiber& other) { harness_switch(&at_, other.at_); }

  private:
    void* at_ = nullptr;
};
#else
class Fiber {
  public:
    void start(char* stack, size_t bytes, void (*entry)()) {
        getcontext(&at_);
        at_.uc_stack.ss_sp = stack, at_.uc_stack.ss_size = bytes, at_.uc_link = nullptr;
        makecontext(&at_, entry, 0);
    }
    void go_to(const Fiber& other) { swapcontext(&at_, &other.at_); }

  private:
    ucontext_t at_;
};
#endif

}  // namespace
}  // namespace harness
