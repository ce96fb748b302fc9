	.file	"<string>"
	.section	.ltext,"axl",@progbits
	.globl	_ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx
	.p2align	4
	.type	_ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx,@function
_ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx:
	pushq	%rbp
	pushq	%r15
	pushq	%r14
	pushq	%r13
	pushq	%r12
	pushq	%rbx
	subq	$240, %rsp
	movq	1232(%rsp), %rax
	movq	%rdi, 72(%rsp)
	testq	%rax, %rax
	jle	.LBB0_37
	movq	1240(%rsp), %rcx
	movq	440(%rsp), %r8
	movq	504(%rsp), %rsi
	movq	368(%rsp), %r10
	movq	424(%rsp), %r9
	movq	352(%rsp), %r11
	movq	664(%rsp), %rdx
	movq	%rcx, %rdi
	andq	$-4, %rdi
	cmpq	$4, %rcx
	leaq	(,%r10,8), %r10
	movq	%r8, %rbx
	movq	%rdi, 112(%rsp)
	movl	$3, %edi
	cmovgeq	%rcx, %rdi
	shlq	$3, %rsi
	andl	$3, %ecx
	movq	%r10, 64(%rsp)
	leaq	192(%r11), %r10
	shlq	$5, %rbx
	shrq	$2, %rdi
	movq	%rsi, 168(%rsp)
	movq	%rcx, -48(%rsp)
	movq	%r8, %rcx
	shlq	$4, %rcx
	movq	%r10, 152(%rsp)
	leaq	16(%r11), %r10
	movq	%rbx, (%rsp)
	movq	%rdi, 8(%rsp)
	leaq	(,%r8,8), %rdi
	leaq	(%r9,%rcx), %r15
	movq	%rcx, 104(%rsp)
	leaq	16(%r9,%rcx), %rcx
	movq	%r10, 144(%rsp)
	movq	%r15, -16(%rsp)
	leaq	(%rdi,%rdi,2), %rsi
	movq	%rcx, 88(%rsp)
	leaq	(%r9,%rsi), %r14
	leaq	24(%r9,%rsi), %rsi
	movq	%r14, -8(%rsp)
	leaq	(%r9,%r8,8), %r14
	leaq	16(%r9,%r8,8), %r8
	movq	%rsi, 80(%rsp)
	leaq	56(%r9), %rsi
	movq	%r14, -24(%rsp)
	leaq	64(%r11), %r14
	movq	%r8, 96(%rsp)
	leaq	192(%r9), %r8
	movq	%rsi, 128(%rsp)
	movq	%r14, 160(%rsp)
	movq	%r8, 136(%rsp)
	jmp	.LBB0_2
	.p2align	4
.LBB0_36:
	movq	120(%rsp), %rax
	movq	664(%rsp), %rdx
	movq	(%rsp), %rbx
	decq	%rax
	movq	$0, 80(%rdx)
	jle	.LBB0_37
.LBB0_2:
	movq	%rax, 120(%rsp)
	movq	1240(%rsp), %rax
	movq	%rax, 80(%rdx)
	movq	1136(%rsp), %rax
	vcvttsd2si	(%rax), %rax
	movq	48(%rdx), %rcx
	addq	40(%rdx), %rax
	leaq	7(%rcx,%rax,2), %r8
	leaq	(%rcx,%rax,2), %rdx
	movabsq	$-9223372036854775801, %rax
	movq	%r8, -120(%rsp)
	andq	$-8, %r8
	cmpq	$0, 8(%rsp)
	leaq	(%rdx,%rax), %rcx
	leaq	1(%rax), %rax
	movq	%rdx, -104(%rsp)
	movq	%rcx, -32(%rsp)
	movq	%rax, -40(%rsp)
	je	.LBB0_20
	movq	-40(%rsp), %rax
	cmpq	%rax, -32(%rsp)
	jb	.LBB0_20
	movq	-104(%rsp), %rax
	movabsq	$2305843009213693944, %rdx
	movq	-120(%rsp), %rbp
	movq	352(%rsp), %rsi
	movq	80(%rsp), %r10
	xorl	%r9d, %r9d
	leaq	7(%rdx,%rax), %rax
	imulq	368(%rsp), %rax
	movq	%rbp, %rcx
	andq	%rdx, %rcx
	movq	%r10, 56(%rsp)
	movq	96(%rsp), %r10
	andq	$-16, %rbp
	movq	%r10, 40(%rsp)
	movq	-16(%rsp), %r10
	addq	%rax, %rcx
	leaq	(%rsi,%rcx,8), %rax
	movq	424(%rsp), %rsi
	movq	%rax, 208(%rsp)
	leaq	(%rdi,%rdi,2), %rax
	movq	%r10, 24(%rsp)
	leaq	(%rsi,%r8,8), %rcx
	leaq	(%rcx,%rdi), %rdx
	addq	%rcx, %rax
	movq	%rcx, 200(%rsp)
	movq	%rdx, 176(%rsp)
	movq	88(%rsp), %rdx
	movq	%rax, 192(%rsp)
	movq	104(%rsp), %rax
	movq	%rdx, 48(%rsp)
	movq	-24(%rsp), %rdx
	addq	%rcx, %rax
	xorl	%ecx, %ecx
	movq	%rax, 184(%rsp)
	movq	%rdx, 32(%rsp)
	movq	-8(%rsp), %rdx
	movq	%rdx, 16(%rsp)
	jmp	.LBB0_5
	.p2align	4
.LBB0_19:
	movq	(%rsp), %rbx
	movq	-112(%rsp), %rcx
	movq	224(%rsp), %r9
	addq	%rbx, 16(%rsp)
	addq	%rbx, 24(%rsp)
	addq	%rbx, 32(%rsp)
	addq	%rbx, 40(%rsp)
	addq	%rbx, 48(%rsp)
	addq	%rbx, 56(%rsp)
	addq	$4, %rcx
	incq	%r9
	addq	%rbx, %rsi
	cmpq	8(%rsp), %r9
	je	.LBB0_20
.LBB0_5:
	cmpq	$8, -120(%rsp)
	movabsq	$1152921504606846976, %rax
	movq	%r9, 224(%rsp)
	movq	424(%rsp), %r13
	movq	440(%rsp), %r10
	movq	%rcx, %r11
	movq	%rcx, %rdx
	movq	%rcx, %r14
	movq	%rcx, -112(%rsp)
	setb	-122(%rsp)
	testq	%rax, 368(%rsp)
	movq	-8(%rsp), %rax
	setne	-121(%rsp)
	imulq	%rbx, %r9
	orq	$1, %r11
	orq	$2, %rdx
	imulq	%r10, %r14
	movq	%r11, -56(%rsp)
	imulq	%r10, %r11
	movq	%rdx, -64(%rsp)
	imulq	%r10, %rdx
	leaq	(%rax,%r9), %r15
	movq	192(%rsp), %rax
	leaq	(%r13,%r14,8), %r14
	leaq	(%r13,%rdx,8), %rdx
	leaq	(%r13,%r11,8), %r11
	movq	%rdx, 232(%rsp)
	leaq	(%rax,%r9), %r12
	movq	-16(%rsp), %rax
	addq	%r9, %rax
	movq	%rax, -80(%rsp)
	movq	184(%rsp), %rax
	leaq	(%rax,%r9), %rbx
	movq	-24(%rsp), %rax
	addq	%r9, %rax
	movq	%rax, -96(%rsp)
	movq	176(%rsp), %rax
	addq	%r9, %rax
	movq	%rax, -88(%rsp)
	leaq	(%r13,%r9), %rax
	addq	200(%rsp), %r9
	movq	%rax, 216(%rsp)
	movq	%rcx, %rax
	orq	$3, %rax
	movq	208(%rsp), %rcx
	movq	%rax, -72(%rsp)
	imulq	%r10, %rax
	movq	352(%rsp), %r10
	leaq	(%r13,%rax,8), %rax
	cmpq	%r12, %r10
	setb	%r12b
	cmpq	%rcx, %r15
	setb	%r15b
	andb	%r12b, %r15b
	cmpq	%rbx, %r10
	setb	%r12b
	cmpq	%rcx, -80(%rsp)
	movq	%r14, -80(%rsp)
	setb	%bl
	andb	%r12b, %bl
	orb	%r15b, %bl
	cmpq	-88(%rsp), %r10
	movq	%r11, -88(%rsp)
	setb	%dl
	cmpq	%rcx, -96(%rsp)
	movq	%rax, -96(%rsp)
	setb	%al
	andb	%dl, %al
	cmpq	%r9, %r10
	setb	%dl
	cmpq	%rcx, 216(%rsp)
	setb	%cl
	xorl	%r11d, %r11d
	andb	%dl, %cl
	orb	%al, %cl
	movq	144(%rsp), %rax
	orb	%bl, %cl
	orb	-121(%rsp), %cl
	movq	%r10, %rbx
	movq	160(%rsp), %r10
	orb	-122(%rsp), %cl
	movb	%cl, -122(%rsp)
	jmp	.LBB0_6
	.p2align	4
.LBB0_18:
	movq	64(%rsp), %rcx
	incq	%r11
	addq	%rcx, %r10
	addq	%rcx, %rbx
	addq	%rcx, %rax
	cmpq	%r11, -104(%rsp)
	je	.LBB0_19
.LBB0_6:
	movq	496(%rsp), %rcx
	movq	-112(%rsp), %rdx
	movq	-80(%rsp), %r9
	movq	-88(%rsp), %r14
	testb	$1, -122(%rsp)
	vmovsd	(%rcx,%rdx,8), %xmm0
	movq	-56(%rsp), %rdx
	vmulsd	(%r9,%r11,8), %xmm0, %xmm0
	movq	232(%rsp), %r9
	vmovsd	(%rcx,%rdx,8), %xmm1
	movq	-64(%rsp), %rdx
	vmulsd	(%r14,%r11,8), %xmm1, %xmm1
	vmovsd	(%rcx,%rdx,8), %xmm2
	movq	-72(%rsp), %rdx
	vmulsd	(%r9,%r11,8), %xmm2, %xmm2
	vmovsd	(%rcx,%rdx,8), %xmm3
	movq	-96(%rsp), %rdx
	vmulsd	(%rdx,%r11,8), %xmm3, %xmm3
	je	.LBB0_10
	xorl	%edx, %edx
.LBB0_8:
	movq	48(%rsp), %r9
	movq	40(%rsp), %rcx
	movq	%r8, %r12
	leaq	(%rax,%rdx,8), %r14
	subq	%rdx, %r12
	leaq	(%rsi,%rdx,8), %r15
	leaq	(%r9,%rdx,8), %r13
	movq	56(%rsp), %r9
	leaq	(%rcx,%rdx,8), %rcx
	leaq	(%r9,%rdx,8), %rdx
	xorl	%r9d, %r9d
	.p2align	4
.LBB0_9:
	vmulsd	(%r15,%r9,8), %xmm0, %xmm4
	vmulsd	-16(%rcx,%r9,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-16(%r13,%r9,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-24(%rdx,%r9,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-16(%r14,%r9,8), %xmm4, %xmm4
	vmovsd	%xmm4, -16(%r14,%r9,8)
	vmulsd	8(%r15,%r9,8), %xmm0, %xmm4
	vmulsd	-8(%rcx,%r9,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-8(%r13,%r9,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-16(%rdx,%r9,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-8(%r14,%r9,8), %xmm4, %xmm4
	vmovsd	%xmm4, -8(%r14,%r9,8)
	vmulsd	16(%r15,%r9,8), %xmm0, %xmm4
	vmulsd	(%rcx,%r9,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	(%r13,%r9,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-8(%rdx,%r9,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	(%r14,%r9,8), %xmm4, %xmm4
	vmovsd	%xmm4, (%r14,%r9,8)
	vmulsd	24(%r15,%r9,8), %xmm0, %xmm4
	vmulsd	8(%rcx,%r9,8), %xmm1, %xmm5
	vmulsd	8(%r13,%r9,8), %xmm2, %xmm7
	vmulsd	(%rdx,%r9,8), %xmm3, %xmm6
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	%xmm7, %xmm4, %xmm4
	vaddsd	%xmm6, %xmm4, %xmm4
	vaddsd	8(%r14,%r9,8), %xmm4, %xmm4
	vmovsd	%xmm4, 8(%r14,%r9,8)
	addq	$4, %r9
	cmpq	%r9, %r12
	jne	.LBB0_9
	jmp	.LBB0_18
	.p2align	4
.LBB0_10:
	cmpq	$16, -120(%rsp)
	vbroadcastsd	%xmm0, %zmm4
	vbroadcastsd	%xmm1, %zmm5
	vbroadcastsd	%xmm2, %zmm6
	vbroadcastsd	%xmm3, %zmm7
	jae	.LBB0_12
	xorl	%r12d, %r12d
.LBB0_16:
	movq	32(%rsp), %rcx
	movq	24(%rsp), %rdx
	movq	16(%rsp), %r9
	movq	%r8, %r14
	subq	%r12, %r14
	leaq	(%rsi,%r12,8), %r15
	xorl	%r13d, %r13d
	leaq	(%rcx,%r12,8), %rcx
	leaq	(%rdx,%r12,8), %rdx
	leaq	(%r9,%r12,8), %r9
	leaq	(%rbx,%r12,8), %r12
	.p2align	4
.LBB0_17:
	vmulpd	(%r15,%r13,8), %zmm4, %zmm0
	vmulpd	(%rcx,%r13,8), %zmm5, %zmm1
	vmulpd	(%rdx,%r13,8), %zmm6, %zmm3
	vmulpd	(%r9,%r13,8), %zmm7, %zmm2
	vaddpd	%zmm1, %zmm0, %zmm0
	vaddpd	%zmm3, %zmm0, %zmm0
	vaddpd	%zmm2, %zmm0, %zmm0
	vaddpd	(%r12,%r13,8), %zmm0, %zmm0
	vmovupd	%zmm0, (%r12,%r13,8)
	addq	$8, %r13
	cmpq	%r13, %r14
	jne	.LBB0_17
	jmp	.LBB0_18
	.p2align	4
.LBB0_12:
	xorl	%ecx, %ecx
	.p2align	4
.LBB0_13:
	leaq	(%rsi,%rcx,8), %rdx
	vmulpd	64(%rsi,%rcx,8), %zmm4, %zmm9
	vmulpd	(%rsi,%rcx,8), %zmm4, %zmm8
	vmulpd	64(%rdi,%rdx), %zmm5, %zmm11
	vmulpd	(%rdi,%rdx), %zmm5, %zmm10
	leaq	(%rdx,%rdi), %r9
	vmulpd	(%rdi,%r9), %zmm6, %zmm12
	leaq	(%r9,%rdi), %rdx
	vaddpd	%zmm11, %zmm9, %zmm9
	vmulpd	64(%rdi,%r9), %zmm6, %zmm11
	vaddpd	%zmm10, %zmm8, %zmm8
	vaddpd	%zmm12, %zmm8, %zmm8
	vmulpd	(%rdi,%rdx), %zmm7, %zmm12
	vaddpd	%zmm11, %zmm9, %zmm9
	vmulpd	64(%rdi,%rdx), %zmm7, %zmm11
	vaddpd	%zmm12, %zmm8, %zmm8
	vaddpd	-64(%r10,%rcx,8), %zmm8, %zmm8
	vaddpd	%zmm11, %zmm9, %zmm9
	vaddpd	(%r10,%rcx,8), %zmm9, %zmm9
	vmovupd	%zmm8, -64(%r10,%rcx,8)
	vmovupd	%zmm9, (%r10,%rcx,8)
	addq	$16, %rcx
	cmpq	%rcx, %rbp
	jne	.LBB0_13
	cmpq	%rbp, %r8
	je	.LBB0_18
	testb	$8, -120(%rsp)
	movq	%rbp, %r12
	movq	%rbp, %rdx
	je	.LBB0_8
	jmp	.LBB0_16
	.p2align	4
.LBB0_20:
	cmpq	$0, -48(%rsp)
	je	.LBB0_36
	movq	-40(%rsp), %rax
	cmpq	%rax, -32(%rsp)
	jb	.LBB0_36
	movq	-104(%rsp), %rax
	movq	-120(%rsp), %r12
	movabsq	$2305843009213693944, %rdx
	movq	112(%rsp), %rsi
	leaq	7(%rdx,%rax), %rax
	imulq	368(%rsp), %rax
	movq	%r12, %rcx
	andq	%rdx, %rcx
	movq	352(%rsp), %rdx
	andq	$-32, %r12
	addq	%rax, %rcx
	leaq	(%rdx,%rcx,8), %rax
	movq	424(%rsp), %rcx
	movq	%rax, -64(%rsp)
	leaq	(%rcx,%r8,8), %rax
	movq	%rax, -72(%rsp)
	movq	-48(%rsp), %rax
	jmp	.LBB0_23
	.p2align	4
.LBB0_35:
	movq	-56(%rsp), %rsi
	movq	-112(%rsp), %rax
	incq	%rsi
	decq	%rax
	jle	.LBB0_36
.LBB0_23:
	cmpq	$8, -120(%rsp)
	movabsq	$1152921504606846976, %rcx
	movq	%rax, -112(%rsp)
	movq	%rsi, %r10
	movq	496(%rsp), %rdx
	movq	%rsi, -56(%rsp)
	movq	-72(%rsp), %r14
	movq	352(%rsp), %r13
	setb	%al
	testq	%rcx, 368(%rsp)
	leaq	(%rdx,%rsi,8), %r9
	setne	%cl
	sarq	$63, %r10
	movq	%r10, %r11
	andq	432(%rsp), %r11
	addq	%rsi, %r11
	movq	424(%rsp), %rsi
	movq	%r11, %rdx
	imulq	440(%rsp), %rdx
	imulq	%rdi, %r11
	leaq	(%rsi,%r11), %r15
	leaq	(%rsi,%rdx,8), %rbx
	leaq	(%r14,%r11), %rdx
	cmpq	%rdx, %r13
	setb	%dl
	cmpq	-64(%rsp), %rbx
	setb	%bpl
	andq	168(%rsp), %r10
	andb	%dl, %bpl
	orb	%cl, %bpl
	movq	152(%rsp), %rcx
	orb	%al, %bpl
	movq	136(%rsp), %rax
	leaq	(%rax,%r11), %r14
	addq	128(%rsp), %r11
	xorl	%eax, %eax
	jmp	.LBB0_24
	.p2align	4
.LBB0_34:
	movq	64(%rsp), %rdx
	incq	%rax
	addq	%rdx, %rcx
	addq	%rdx, %r13
	cmpq	%rax, -104(%rsp)
	je	.LBB0_35
.LBB0_24:
	vmovsd	(%r9,%r10), %xmm0
	vmulsd	(%rbx,%rax,8), %xmm0, %xmm0
	testb	$1, %bpl
	je	.LBB0_27
	xorl	%edx, %edx
	.p2align	4
.LBB0_26:
	vmulsd	-56(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, (%r13,%rdx,8)
	vmulsd	-48(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	8(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, 8(%r13,%rdx,8)
	vmulsd	-40(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	16(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, 16(%r13,%rdx,8)
	vmulsd	-32(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	24(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, 24(%r13,%rdx,8)
	vmulsd	-24(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	32(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, 32(%r13,%rdx,8)
	vmulsd	-16(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	40(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, 40(%r13,%rdx,8)
	vmulsd	-8(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	48(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, 48(%r13,%rdx,8)
	vmulsd	(%r11,%rdx,8), %xmm0, %xmm1
	vaddsd	56(%r13,%rdx,8), %xmm1, %xmm1
	vmovsd	%xmm1, 56(%r13,%rdx,8)
	addq	$8, %rdx
	cmpq	%rdx, %r8
	jne	.LBB0_26
	jmp	.LBB0_34
	.p2align	4
.LBB0_27:
	cmpq	$32, -120(%rsp)
	vbroadcastsd	%xmm0, %zmm1
	jae	.LBB0_29
	xorl	%esi, %esi
	jmp	.LBB0_33
	.p2align	4
.LBB0_29:
	xorl	%edx, %edx
	.p2align	4
.LBB0_30:
	vmulpd	-192(%r14,%rdx,8), %zmm1, %zmm2
	vmulpd	-128(%r14,%rdx,8), %zmm1, %zmm3
	vmulpd	-64(%r14,%rdx,8), %zmm1, %zmm4
	vmulpd	(%r14,%rdx,8), %zmm1, %zmm5
	vaddpd	-192(%rcx,%rdx,8), %zmm2, %zmm2
	vaddpd	-128(%rcx,%rdx,8), %zmm3, %zmm3
	vaddpd	-64(%rcx,%rdx,8), %zmm4, %zmm4
	vaddpd	(%rcx,%rdx,8), %zmm5, %zmm5
	vmovupd	%zmm2, -192(%rcx,%rdx,8)
	vmovupd	%zmm3, -128(%rcx,%rdx,8)
	vmovupd	%zmm4, -64(%rcx,%rdx,8)
	vmovupd	%zmm5, (%rcx,%rdx,8)
	addq	$32, %rdx
	cmpq	%rdx, %r12
	jne	.LBB0_30
	cmpq	%r12, %r8
	je	.LBB0_34
	testb	$24, -120(%rsp)
	movq	%r12, %rdx
	movq	%r12, %rsi
	je	.LBB0_26
	.p2align	4
.LBB0_33:
	vmulpd	(%r15,%rsi,8), %zmm1, %zmm0
	vaddpd	(%r13,%rsi,8), %zmm0, %zmm0
	vmovupd	%zmm0, (%r13,%rsi,8)
	addq	$8, %rsi
	cmpq	%rsi, %r8
	jne	.LBB0_33
	jmp	.LBB0_34
.LBB0_37:
	movq	72(%rsp), %rax
	movq	$0, (%rax)
	xorl	%eax, %eax
	addq	$240, %rsp
	popq	%rbx
	popq	%r12
	popq	%r13
	popq	%r14
	popq	%r15
	popq	%rbp
	vzeroupper
	retq
.Lfunc_end0:
	.size	_ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx, .Lfunc_end0-_ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx

	.globl	_ZN7cpython8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx
	.p2align	4
	.type	_ZN7cpython8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx,@function
_ZN7cpython8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx:
	.cfi_startproc
	pushq	%rbp
	.cfi_def_cfa_offset 16
	pushq	%r15
	.cfi_def_cfa_offset 24
	pushq	%r14
	.cfi_def_cfa_offset 32
	pushq	%r13
	.cfi_def_cfa_offset 40
	pushq	%r12
	.cfi_def_cfa_offset 48
	pushq	%rbx
	.cfi_def_cfa_offset 56
	subq	$2136, %rsp
	.cfi_def_cfa_offset 2192
	.cfi_offset %rbx, -56
	.cfi_offset %r12, -48
	.cfi_offset %r13, -40
	.cfi_offset %r14, -32
	.cfi_offset %r15, -24
	.cfi_offset %rbp, -16
	movq	%rsi, %rdi
	leaq	1032(%rsp), %rax
	movabsq	$.const.r_settle, %rsi
	movabsq	$PyArg_UnpackTuple, %r10
	leaq	1048(%rsp), %r8
	leaq	1040(%rsp), %r9
	movl	$3, %edx
	movl	$3, %ecx
	xorl	%ebx, %ebx
	movq	%rax, (%rsp)
	xorl	%eax, %eax
	callq	*%r10
	vxorps	%xmm0, %xmm0, %xmm0
	vxorps	%xmm1, %xmm1, %xmm1
	vmovups	%ymm0, 1664(%rsp)
	vmovups	%ymm0, 1056(%rsp)
	vmovups	%ymm0, 1600(%rsp)
	vmovups	%ymm0, 1536(%rsp)
	vmovups	%ymm0, 1184(%rsp)
	vmovups	%ymm0, 1496(%rsp)
	vmovups	%zmm1, 2048(%rsp)
	vmovups	%ymm0, 1408(%rsp)
	vmovups	%ymm0, 1120(%rsp)
	vmovups	%ymm0, 1688(%rsp)
	vmovups	%zmm1, 1328(%rsp)
	movq	$0, 1392(%rsp)
	vmovups	%zmm1, 1248(%rsp)
	movq	$0, 1312(%rsp)
	vmovups	%ymm0, 1080(%rsp)
	vmovups	%ymm0, 1624(%rsp)
	vmovups	%ymm0, 1560(%rsp)
	vmovups	%ymm0, 1208(%rsp)
	vmovups	%ymm0, 1472(%rsp)
	vmovups	%zmm1, 1968(%rsp)
	movq	$0, 2032(%rsp)
	vmovups	%zmm1, 1888(%rsp)
	movq	$0, 1952(%rsp)
	vmovups	%zmm1, 2072(%rsp)
	vmovups	%zmm1, 1808(%rsp)
	movq	$0, 1872(%rsp)
	vmovups	%ymm0, 1432(%rsp)
	vmovups	%ymm0, 1144(%rsp)
	vmovups	%zmm1, 1728(%rsp)
	movq	$0, 1792(%rsp)
	movq	$0, 1024(%rsp)
	testl	%eax, %eax
	je	.LBB1_40
	movabsq	$_ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx, %rax
	cmpq	$0, (%rax)
	je	.LBB1_42
	movq	1048(%rsp), %rbx
	movabsq	$PyTuple_Size, %rax
	movq	%rbx, %rdi
	vzeroupper
	callq	*%rax
	cmpq	$15, %rax
	setne	%r13b
	jne	.LBB1_57
.LBB1_3:
	movabsq	$PyTuple_GetItem, %r14
	movq	%rbx, %rdi
	xorl	%esi, %esi
	callq	*%r14
	movabsq	$numba_adapt_ndarray, %r15
	leaq	1664(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1664(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1688(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_43
	cmpq	$8, 1688(%rsp)
	jne	.LBB1_43
.LBB1_5:
	movl	$1, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1328(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1328(%rsp)
	movq	$0, 1392(%rsp)
	vzeroupper
	callq	*%r15
	cmpq	$8, 1352(%rsp)
	setne	%cl
	testl	%eax, %eax
	setne	%bpl
	orb	%cl, %bpl
	cmpb	$1, %bpl
	je	.LBB1_58
	testb	%bpl, %bpl
	jne	.LBB1_59
.LBB1_7:
	movq	1376(%rsp), %rax
	movq	1360(%rsp), %r12
	movl	$2, %esi
	movq	%rbx, %rdi
	movq	%rax, 1016(%rsp)
	callq	*%r14
	leaq	1248(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1248(%rsp)
	movq	$0, 1312(%rsp)
	vzeroupper
	callq	*%r15
	cmpq	$8, 1272(%rsp)
	setne	%cl
	testl	%eax, %eax
	setne	%bpl
	orb	%cl, %bpl
	cmpb	$1, %bpl
	je	.LBB1_60
	testb	%bpl, %bpl
	jne	.LBB1_61
.LBB1_9:
	movq	1288(%rsp), %rax
	movq	1296(%rsp), %rcx
	movq	1280(%rsp), %rbp
	movl	$3, %esi
	movq	%rbx, %rdi
	movq	%rax, 1008(%rsp)
	movq	%rcx, 1000(%rsp)
	callq	*%r14
	leaq	1056(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1056(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1080(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_44
	cmpq	$8, 1080(%rsp)
	jne	.LBB1_44
.LBB1_11:
	movq	1088(%rsp), %rax
	movq	1096(%rsp), %rcx
	movl	$4, %esi
	movq	%rbx, %rdi
	movq	%rax, 992(%rsp)
	movq	%rcx, 984(%rsp)
	callq	*%r14
	leaq	1600(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1600(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1624(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_45
	cmpq	$8, 1624(%rsp)
	jne	.LBB1_45
.LBB1_13:
	movl	$5, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1536(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1536(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1560(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_46
	cmpq	$8, 1560(%rsp)
	jne	.LBB1_46
.LBB1_15:
	movl	$6, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1184(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1184(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1208(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_47
	cmpq	$8, 1208(%rsp)
	jne	.LBB1_47
.LBB1_17:
	movq	1216(%rsp), %rax
	movl	$7, %esi
	movq	%rbx, %rdi
	movq	%rax, 976(%rsp)
	callq	*%r14
	leaq	1472(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1472(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1496(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_48
	cmpq	$8, 1496(%rsp)
	jne	.LBB1_48
.LBB1_19:
	movl	$8, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1968(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1968(%rsp)
	movq	$0, 2032(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_49
	cmpq	$8, 1992(%rsp)
	jne	.LBB1_49
.LBB1_21:
	movl	$9, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1888(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1888(%rsp)
	movq	$0, 1952(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_50
	cmpq	$8, 1912(%rsp)
	jne	.LBB1_50
.LBB1_23:
	movl	$10, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	2048(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%zmm0, 2048(%rsp)
	movq	%rax, %rdi
	vmovups	%zmm0, 2072(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_51
	cmpq	$8, 2072(%rsp)
	jne	.LBB1_51
.LBB1_25:
	movl	$11, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1808(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1808(%rsp)
	movq	$0, 1872(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_52
	cmpq	$8, 1832(%rsp)
	jne	.LBB1_52
.LBB1_27:
	movl	$12, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1408(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1408(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1432(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_53
	cmpq	$8, 1432(%rsp)
	jne	.LBB1_53
.LBB1_29:
	movl	$13, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1120(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1120(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1144(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_54
	cmpq	$8, 1144(%rsp)
	jne	.LBB1_54
.LBB1_31:
	movq	1152(%rsp), %rax
	movl	$14, %esi
	movq	%rbx, %rdi
	movq	%rax, 968(%rsp)
	callq	*%r14
	leaq	1728(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1728(%rsp)
	movq	$0, 1792(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_55
	cmpq	$8, 1752(%rsp)
	jne	.LBB1_55
	testb	%r13b, %r13b
	jne	.LBB1_41
	movq	1040(%rsp), %rdi
	movabsq	$PyNumber_Long, %r15
	movq	%r12, %rbx
	callq	*%r15
	movabsq	$PyLong_AsLongLong, %r13
	movabsq	$Py_DecRef, %r12
	movq	%rbx, 960(%rsp)
	testq	%rax, %rax
	je	.LBB1_62
	movq	%rax, %rdi
	movq	%rax, %r14
	callq	*%r13
	movq	%r14, %rdi
	movq	%rax, %rbx
	callq	*%r12
.LBB1_36:
	movq	%r12, %r14
	movabsq	$PyErr_Occurred, %r12
	callq	*%r12
	testq	%rax, %rax
	jne	.LBB1_41
	movq	1032(%rsp), %rdi
	callq	*%r15
	testq	%rax, %rax
	je	.LBB1_64
	movq	%rax, %rdi
	movq	%rax, %r15
	callq	*%r13
	movq	%r14, %rcx
	movq	%r15, %rdi
	movq	%rax, %r14
	callq	*%rcx
	callq	*%r12
	testq	%rax, %rax
	jne	.LBB1_41
.LBB1_39:
	movq	976(%rsp), %rdi
	movq	984(%rsp), %r10
	movq	968(%rsp), %rax
	movq	%r14, 944(%rsp)
	movq	%rbx, 936(%rsp)
	movq	%rbp, 128(%rsp)
	movq	%rdi, 368(%rsp)
	movq	992(%rsp), %rdi
	movq	%r10, 208(%rsp)
	movq	1000(%rsp), %r10
	movq	%rax, 840(%rsp)
	movabsq	$_ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx, %rax
	movq	%rdi, 200(%rsp)
	movq	1008(%rsp), %rdi
	movq	%r10, 144(%rsp)
	movq	1016(%rsp), %r10
	movq	%rdi, 136(%rsp)
	movq	960(%rsp), %rdi
	movq	%r10, 72(%rsp)
	movq	%rdi, 56(%rsp)
	leaq	1024(%rsp), %rdi
	callq	*%rax
	movabsq	$_Py_NoneStruct, %rbx
	movabsq	$Py_IncRef, %rax
	movq	%rbx, %rdi
	callq	*%rax
.LBB1_40:
	movq	%rbx, %rax
	addq	$2136, %rsp
	.cfi_def_cfa_offset 56
	popq	%rbx
	.cfi_def_cfa_offset 48
	popq	%r12
	.cfi_def_cfa_offset 40
	popq	%r13
	.cfi_def_cfa_offset 32
	popq	%r14
	.cfi_def_cfa_offset 24
	popq	%r15
	.cfi_def_cfa_offset 16
	popq	%rbp
	.cfi_def_cfa_offset 8
	vzeroupper
	retq
.LBB1_42:
	.cfi_def_cfa_offset 2192
	movabsq	$PyExc_RuntimeError, %rdi
	movabsq	$".const.missing Environment: _ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx", %rsi
	jmp	.LBB1_56
.LBB1_43:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_5
.LBB1_44:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_11
.LBB1_45:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_13
.LBB1_46:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_15
.LBB1_47:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_17
.LBB1_48:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_19
.LBB1_49:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_21
.LBB1_50:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_23
.LBB1_51:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_25
.LBB1_52:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_27
.LBB1_53:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_29
.LBB1_54:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r13b
	jmp	.LBB1_31
.LBB1_55:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
.LBB1_56:
	movabsq	$PyErr_SetString, %rax
	vzeroupper
	callq	*%rax
	xorl	%ebx, %ebx
	jmp	.LBB1_40
.LBB1_57:
	movabsq	$PyExc_ValueError, %rdi
	movabsq	$".const.size mismatch for tuple, expected 15 element(s) but got %zd", %rsi
	movabsq	$PyErr_Format, %rcx
	movq	%rax, %rdx
	xorl	%eax, %eax
	callq	*%rcx
	jmp	.LBB1_3
.LBB1_58:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	testb	%bpl, %bpl
	je	.LBB1_7
.LBB1_59:
	movb	$1, %r13b
	jmp	.LBB1_7
.LBB1_60:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	testb	%bpl, %bpl
	je	.LBB1_9
.LBB1_61:
	movb	$1, %r13b
	jmp	.LBB1_9
.LBB1_62:
	xorl	%ebx, %ebx
	jmp	.LBB1_36
.LBB1_64:
	xorl	%r14d, %r14d
	callq	*%r12
	testq	%rax, %rax
	je	.LBB1_39
.LBB1_41:
	xorl	%ebx, %ebx
	jmp	.LBB1_40
.Lfunc_end1:
	.size	_ZN7cpython8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx, .Lfunc_end1-_ZN7cpython8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx
	.cfi_endproc

	.globl	cfunc._ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx
	.p2align	4
	.type	cfunc._ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx,@function
cfunc._ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx:
	subq	$968, %rsp
	vmovaps	1088(%rsp), %xmm0
	vmovups	1160(%rsp), %xmm1
	vmovups	1896(%rsp), %xmm2
	movq	1016(%rsp), %rax
	movq	1104(%rsp), %rdx
	movq	1328(%rsp), %rsi
	movq	1800(%rsp), %rdi
	movq	1032(%rsp), %rcx
	movq	$0, 960(%rsp)
	vmovups	%xmm2, 936(%rsp)
	movq	%rdi, 840(%rsp)
	movq	%rsi, 368(%rsp)
	vmovups	%xmm1, 200(%rsp)
	movq	%rdx, 144(%rsp)
	vmovups	%xmm0, 128(%rsp)
	movq	%rax, 56(%rsp)
	movabsq	$_ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx, %rax
	leaq	960(%rsp), %rdi
	movq	%rcx, 72(%rsp)
	callq	*%rax
	movq	960(%rsp), %rax
	addq	$968, %rsp
	retq
.Lfunc_end2:
	.size	cfunc._ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx, .Lfunc_end2-cfunc._ZN8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx

	.type	.const.r_settle,@object
	.section	.lrodata,"al",@progbits
.const.r_settle:
	.asciz	"r_settle"
	.size	.const.r_settle, 9

	.type	_ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx,@object
	.comm	_ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx,8,8
	.type	".const.missing Environment: _ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx",@object
	.p2align	4, 0x0
".const.missing Environment: _ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx":
	.asciz	"missing Environment: _ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx"
	.size	".const.missing Environment: _ZN08NumbaEnv8__main__8r_settleB2v1B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xx", 686

	.type	".const.size mismatch for tuple, expected 15 element(s) but got %zd",@object
	.p2align	4, 0x0
".const.size mismatch for tuple, expected 15 element(s) but got %zd":
	.asciz	"size mismatch for tuple, expected 15 element(s) but got %zd"
	.size	".const.size mismatch for tuple, expected 15 element(s) but got %zd", 60

	.type	".const.can't unbox array from PyObject into native value.  The object maybe of a different type",@object
	.p2align	4, 0x0
".const.can't unbox array from PyObject into native value.  The object maybe of a different type":
	.asciz	"can't unbox array from PyObject into native value.  The object maybe of a different type"
	.size	".const.can't unbox array from PyObject into native value.  The object maybe of a different type", 89

	.type	_ZN08NumbaEnv7skyless11positioning13joint_algebra6settleB3v69B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,@object
	.comm	_ZN08NumbaEnv7skyless11positioning13joint_algebra6settleB3v69B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,8,8
	.type	_ZN08NumbaEnv7skyless11positioning11joint_state5widthB3v66B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,@object
	.comm	_ZN08NumbaEnv7skyless11positioning11joint_state5widthB3v66B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,8,8
	.type	_ZN08NumbaEnv7skyless11positioning11joint_state6statesB3v62B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,@object
	.comm	_ZN08NumbaEnv7skyless11positioning11joint_state6statesB3v62B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,8,8
	.type	_ZN08NumbaEnv5numba7cpython8builtins6ol_int12_3clocals_3e4implB3v57B54c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFmRIMlNAE_3dEd,@object
	.comm	_ZN08NumbaEnv5numba7cpython8builtins6ol_int12_3clocals_3e4implB3v57B54c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFmRIMlNAE_3dEd,8,8
	.section	".note.GNU-stack","",@progbits
