	.file	"<string>"
	.section	.ltext,"axl",@progbits
	.globl	_ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx
	.p2align	4
	.type	_ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx,@function
_ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx:
	pushq	%rbp
	pushq	%r15
	pushq	%r14
	pushq	%r13
	pushq	%r12
	pushq	%rbx
	subq	$208, %rsp
	movq	1200(%rsp), %rax
	movq	632(%rsp), %rbx
	movq	%rdi, 72(%rsp)
	testq	%rax, %rax
	jle	.LBB0_91
	movq	1208(%rsp), %rdi
	movq	408(%rsp), %rcx
	movq	392(%rsp), %rdx
	movq	336(%rsp), %rsi
	movq	320(%rsp), %r8
	movq	584(%rsp), %r10
	movq	528(%rsp), %r11
	sarq	$63, %rdi
	andq	472(%rsp), %rdi
	leaq	(,%rcx,8), %r15
	leaq	(,%rsi,8), %rsi
	leaq	(%r15,%r15,2), %r9
	movq	%rsi, 8(%rsp)
	leaq	64(%r8), %rsi
	movq	%rsi, 56(%rsp)
	leaq	24(%r8), %rsi
	leaq	(%rdx,%r9), %r14
	movq	%rsi, -8(%rsp)
	leaq	192(%r8), %rsi
	movq	%rdi, 128(%rsp)
	movq	%rcx, %rdi
	shlq	$5, %rdi
	movq	%r14, 40(%rsp)
	leaq	(%rdx,%rcx,8), %r14
	movq	%rsi, 120(%rsp)
	leaq	192(%rdx), %rsi
	movq	%rdi, 48(%rsp)
	movq	%rcx, %rdi
	leaq	24(%rdx,%rcx,8), %rcx
	shlq	$4, %rdi
	movq	%rsi, 16(%rsp)
	movq	%rdi, 96(%rsp)
	addq	%rdx, %rdi
	movq	%r14, 24(%rsp)
	movq	%rcx, 88(%rsp)
	leaq	24(%rdx,%r9), %rcx
	movq	%rdi, 32(%rsp)
	movq	%rcx, 80(%rsp)
	leaq	64(%rdx), %rcx
	movq	%rcx, 112(%rsp)
	leaq	24(%rdx), %rcx
	movq	%rcx, 104(%rsp)
	xorl	%ecx, %ecx
	jmp	.LBB0_3
	.p2align	4
.LBB0_2:
	movq	%rcx, %rax
	movq	136(%rsp), %rcx
	movq	584(%rsp), %r10
	movq	528(%rsp), %r11
	addq	%rax, %rcx
	movq	144(%rsp), %rax
	decq	%rax
	jle	.LBB0_92
.LBB0_3:
	movq	%rcx, 136(%rsp)
	movq	%rax, 144(%rsp)
	movq	1208(%rsp), %rcx
	movq	1216(%rsp), %rdx
	movq	128(%rsp), %rax
	movq	%rcx, 80(%rbx)
	movq	%rdx, 88(%rbx)
	movq	%rcx, %rdx
	cmpq	$12, %rcx
	jne	.LBB0_6
	movq	1104(%rsp), %rax
	vcvttsd2si	(%rax), %rax
	movq	48(%rbx), %rcx
	movabsq	$9223372036854775776, %rsi
	addq	40(%rbx), %rax
	leaq	(%rcx,%rax,2), %rdi
	leaq	39(%rsi,%rdi), %rdx
	addq	$40, %rsi
	movq	%rdi, -16(%rsp)
	cmpq	%rsi, %rdx
	movq	48(%rsp), %rsi
	jae	.LBB0_11
.LBB0_5:
	movq	632(%rsp), %rbx
	movq	584(%rsp), %r10
	movq	528(%rsp), %r11
	xorl	%edx, %edx
	xorl	%eax, %eax
	movq	$0, 80(%rbx)
.LBB0_6:
	movq	464(%rsp), %rcx
	movq	%rdx, -104(%rsp)
	leaq	(%rcx,%rdx,8), %rcx
	movabsq	$-4616189618054758400, %rdx
	movq	%rdx, (%rcx,%rax,8)
	movq	1104(%rsp), %rax
	vcvttsd2si	(%rax), %rax
	movq	48(%rbx), %rcx
	movq	88(%rbx), %rsi
	addq	40(%rbx), %rax
	testb	$3, %sil
	je	.LBB0_30
	movq	520(%rsp), %rbx
	movq	576(%rsp), %r9
	movq	%rsi, %rdx
	sarq	$63, %rdx
	movq	%rdx, %rdi
	andq	%r11, %rdi
	andq	%r10, %rdx
	leaq	(%rbx,%rsi,8), %r8
	movq	$0, (%r8,%rdi,8)
	leaq	(%r9,%rsi,8), %r8
	movq	$0, (%r8,%rdx,8)
	leaq	1(%rsi), %rdx
	testb	$3, %dl
	je	.LBB0_29
	leaq	(%rbx,%rdx,8), %r8
	cmpq	$-1, %rsi
	movl	$0, %edi
	leaq	(%r9,%rdx,8), %rdx
	cmovlq	%r11, %rdi
	movq	$0, (%r8,%rdi,8)
	movl	$0, %edi
	cmovlq	%r10, %rdi
	movq	$0, (%rdx,%rdi,8)
	leaq	2(%rsi), %rdx
	testb	$3, %dl
	je	.LBB0_29
	leaq	(%rbx,%rdx,8), %r8
	cmpq	$-2, %rsi
	movl	$0, %edi
	leaq	(%r9,%rdx,8), %rdx
	cmovlq	%r11, %rdi
	movq	$0, (%r8,%rdi,8)
	movl	$0, %edi
	cmovlq	%r10, %rdi
	movq	$0, (%rdx,%rdi,8)
	leaq	3(%rsi), %rdx
	testb	$3, %dl
	je	.LBB0_29
	leaq	(%rbx,%rdx,8), %r8
	cmpq	$-3, %rsi
	movl	$0, %edi
	leaq	(%r9,%rdx,8), %rdx
	cmovlq	%r11, %rdi
	movq	$0, (%r8,%rdi,8)
	movl	$0, %edi
	cmovlq	%r10, %rdi
	addq	$4, %rsi
	movq	$0, (%rdx,%rdi,8)
	jmp	.LBB0_30
	.p2align	4
.LBB0_29:
	movq	%rdx, %rsi
.LBB0_30:
	leaq	7(%rcx,%rax,2), %rcx
	leaq	3(%rsi), %r8
	shrq	$2, %r8
	movq	%rcx, -120(%rsp)
	andq	$-8, %rcx
	testq	%rsi, %rsi
	setle	%al
	testq	%r8, %r8
	movq	%rcx, -112(%rsp)
	sete	%dl
	orb	%al, %dl
	je	.LBB0_54
.LBB0_31:
	movq	-104(%rsp), %rcx
	movq	632(%rsp), %rbx
	testq	%rcx, %rcx
	jle	.LBB0_2
	cmpq	$8, -120(%rsp)
	jl	.LBB0_2
	movabsq	$1152921504606846976, %r8
	movq	%rcx, %rdi
	imulq	408(%rsp), %rdi
	movq	-104(%rsp), %r9
	movabsq	$2305843009213693944, %rcx
	movq	-120(%rsp), %r11
	movq	392(%rsp), %r10
	movq	16(%rsp), %r12
	testq	%r8, 408(%rsp)
	leaq	7(%rcx,%r9), %r9
	movq	%r11, %rdx
	setne	%sil
	imulq	408(%rsp), %r9
	andq	%rcx, %rdx
	leaq	(%rdx,%rdi), %r8
	leaq	(%r10,%rdi,8), %rax
	leaq	(%r10,%r8,8), %r8
	addq	%rdx, %r9
	leaq	(%r10,%r9,8), %rdx
	cmpq	%rdx, %rax
	movabsq	$9223372036854775776, %rdx
	setb	%r9b
	cmpq	%r8, %r10
	leaq	(%r12,%rdi,8), %r8
	movq	408(%rsp), %rdi
	setb	%cl
	andq	%rdx, %r11
	xorl	%r14d, %r14d
	andb	%r9b, %cl
	movq	%r11, -72(%rsp)
	orb	%sil, %cl
	movq	520(%rsp), %rsi
	movb	%cl, -96(%rsp)
	movq	-104(%rsp), %rcx
	jmp	.LBB0_35
	.p2align	4
.LBB0_34:
	incq	%r14
	addq	%r15, %r12
	addq	%r15, %r10
	cmpq	%r14, %rcx
	je	.LBB0_2
.LBB0_35:
	movq	88(%rbx), %rbx
	movq	%r14, -88(%rsp)
	testq	%rbx, %rbx
	jle	.LBB0_38
	movq	392(%rsp), %rcx
	movq	%r14, %rdx
	imulq	%rdi, %rdx
	movl	%ebx, %r11d
	andl	$7, %r11d
	leaq	(%rcx,%rdx,8), %r9
	cmpq	$8, %rbx
	jae	.LBB0_39
	movq	-104(%rsp), %rcx
	vxorpd	%xmm0, %xmm0, %xmm0
	xorl	%ebx, %ebx
	jmp	.LBB0_42
	.p2align	4
.LBB0_38:
	vxorpd	%xmm0, %xmm0, %xmm0
	jmp	.LBB0_44
	.p2align	4
.LBB0_39:
	movabsq	$9223372036854775776, %rcx
	vxorpd	%xmm0, %xmm0, %xmm0
	xorl	%r14d, %r14d
	leaq	24(%rcx), %rdx
	movq	%rdi, %rcx
	movq	%rsi, %rdi
	movq	576(%rsp), %rsi
	andq	%rdx, %rbx
	.p2align	4
.LBB0_40:
	movq	(%rdi,%r14,8), %rdx
	vmovsd	(%rsi,%r14,8), %xmm1
	movq	8(%rdi,%r14,8), %r13
	vmovsd	8(%rsi,%r14,8), %xmm2
	leaq	(%r9,%rdx,8), %rbp
	sarq	$63, %rdx
	andq	%rcx, %rdx
	vmulsd	(%rbp,%rdx,8), %xmm1, %xmm1
	leaq	(%r9,%r13,8), %rdx
	sarq	$63, %r13
	andq	%rcx, %r13
	vaddsd	%xmm1, %xmm0, %xmm0
	vmulsd	(%rdx,%r13,8), %xmm2, %xmm1
	movq	16(%rdi,%r14,8), %rdx
	leaq	(%r9,%rdx,8), %r13
	sarq	$63, %rdx
	andq	%rcx, %rdx
	vaddsd	%xmm1, %xmm0, %xmm0
	vmovsd	16(%rsi,%r14,8), %xmm1
	vmulsd	(%r13,%rdx,8), %xmm1, %xmm1
	movq	24(%rdi,%r14,8), %rdx
	leaq	(%r9,%rdx,8), %r13
	sarq	$63, %rdx
	andq	%rcx, %rdx
	vaddsd	%xmm1, %xmm0, %xmm0
	vmovsd	24(%rsi,%r14,8), %xmm1
	vmulsd	(%r13,%rdx,8), %xmm1, %xmm1
	movq	32(%rdi,%r14,8), %rdx
	leaq	(%r9,%rdx,8), %r13
	sarq	$63, %rdx
	andq	%rcx, %rdx
	vaddsd	%xmm1, %xmm0, %xmm0
	vmovsd	32(%rsi,%r14,8), %xmm1
	vmulsd	(%r13,%rdx,8), %xmm1, %xmm1
	movq	40(%rdi,%r14,8), %rdx
	leaq	(%r9,%rdx,8), %r13
	sarq	$63, %rdx
	andq	%rcx, %rdx
	vaddsd	%xmm1, %xmm0, %xmm0
	vmovsd	40(%rsi,%r14,8), %xmm1
	vmulsd	(%r13,%rdx,8), %xmm1, %xmm1
	movq	48(%rdi,%r14,8), %rdx
	leaq	(%r9,%rdx,8), %r13
	sarq	$63, %rdx
	andq	%rcx, %rdx
	vaddsd	%xmm1, %xmm0, %xmm0
	vmovsd	48(%rsi,%r14,8), %xmm1
	vmulsd	(%r13,%rdx,8), %xmm1, %xmm1
	movq	56(%rdi,%r14,8), %rdx
	leaq	(%r9,%rdx,8), %r13
	sarq	$63, %rdx
	andq	%rcx, %rdx
	vaddsd	%xmm1, %xmm0, %xmm0
	vmovsd	56(%rsi,%r14,8), %xmm1
	addq	$8, %r14
	vmulsd	(%r13,%rdx,8), %xmm1, %xmm1
	vaddsd	%xmm1, %xmm0, %xmm0
	cmpq	%r14, %rbx
	jne	.LBB0_40
	movq	%rdi, %rsi
	movq	%rcx, %rdi
	movq	-104(%rsp), %rcx
	testq	%r11, %r11
	je	.LBB0_44
.LBB0_42:
	movq	576(%rsp), %rdx
	leaq	(%rsi,%rbx,8), %r14
	xorl	%r13d, %r13d
	leaq	(%rdx,%rbx,8), %rbx
	.p2align	4
.LBB0_43:
	movq	(%r14,%r13,8), %rbp
	vmovsd	(%rbx,%r13,8), %xmm1
	incq	%r13
	leaq	(%r9,%rbp,8), %rdx
	sarq	$63, %rbp
	andq	%rdi, %rbp
	vmulsd	(%rdx,%rbp,8), %xmm1, %xmm1
	vaddsd	%xmm1, %xmm0, %xmm0
	cmpq	%r13, %r11
	jne	.LBB0_43
.LBB0_44:
	movq	464(%rsp), %rdx
	movq	-88(%rsp), %r14
	cmpb	$0, -96(%rsp)
	vmulsd	(%rdx,%r14,8), %xmm0, %xmm0
	je	.LBB0_47
	movq	632(%rsp), %rbx
	movq	-112(%rsp), %rdx
	xorl	%r9d, %r9d
	.p2align	4
.LBB0_46:
	vmulsd	(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, (%rax,%r9,8)
	vmulsd	8(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	8(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, 8(%rax,%r9,8)
	vmulsd	16(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	16(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, 16(%rax,%r9,8)
	vmulsd	24(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	24(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, 24(%rax,%r9,8)
	vmulsd	32(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	32(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, 32(%rax,%r9,8)
	vmulsd	40(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	40(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, 40(%rax,%r9,8)
	vmulsd	48(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	48(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, 48(%rax,%r9,8)
	vmulsd	56(%r10,%r9,8), %xmm0, %xmm1
	vaddsd	56(%rax,%r9,8), %xmm1, %xmm1
	vmovsd	%xmm1, 56(%rax,%r9,8)
	addq	$8, %r9
	cmpq	%r9, %rdx
	jne	.LBB0_46
	jmp	.LBB0_34
	.p2align	4
.LBB0_47:
	cmpq	$32, -120(%rsp)
	movq	-112(%rsp), %rdx
	vbroadcastsd	%xmm0, %zmm1
	jae	.LBB0_49
	movq	632(%rsp), %rbx
	xorl	%r11d, %r11d
	jmp	.LBB0_53
	.p2align	4
.LBB0_49:
	movq	632(%rsp), %rbx
	movq	-72(%rsp), %r11
	xorl	%r9d, %r9d
	.p2align	4
.LBB0_50:
	vmulpd	-192(%r12,%r9,8), %zmm1, %zmm2
	vmulpd	-128(%r12,%r9,8), %zmm1, %zmm3
	vmulpd	-64(%r12,%r9,8), %zmm1, %zmm4
	vmulpd	(%r12,%r9,8), %zmm1, %zmm5
	vaddpd	-192(%r8,%r9,8), %zmm2, %zmm2
	vaddpd	-128(%r8,%r9,8), %zmm3, %zmm3
	vaddpd	-64(%r8,%r9,8), %zmm4, %zmm4
	vaddpd	(%r8,%r9,8), %zmm5, %zmm5
	vmovupd	%zmm2, -192(%r8,%r9,8)
	vmovupd	%zmm3, -128(%r8,%r9,8)
	vmovupd	%zmm4, -64(%r8,%r9,8)
	vmovupd	%zmm5, (%r8,%r9,8)
	addq	$32, %r9
	cmpq	%r9, %r11
	jne	.LBB0_50
	cmpq	%r11, %rdx
	je	.LBB0_34
	movq	-72(%rsp), %r11
	testb	$24, -120(%rsp)
	movq	%r11, %r9
	je	.LBB0_46
	.p2align	4
.LBB0_53:
	vmulpd	(%r10,%r11,8), %zmm1, %zmm0
	vaddpd	(%rax,%r11,8), %zmm0, %zmm0
	vmovupd	%zmm0, (%rax,%r11,8)
	addq	$8, %r11
	cmpq	%r11, %rdx
	jne	.LBB0_53
	jmp	.LBB0_34
	.p2align	4
.LBB0_54:
	movq	-104(%rsp), %rcx
	movq	-120(%rsp), %rdi
	movabsq	$2305843009213693944, %rsi
	movq	104(%rsp), %r9
	xorl	%r12d, %r12d
	movq	%rcx, %rax
	sarq	$63, %rax
	andq	400(%rsp), %rax
	addq	%rcx, %rax
	imulq	408(%rsp), %rax
	movq	392(%rsp), %rcx
	leaq	(%rcx,%rax,8), %rdx
	movq	%rdx, -96(%rsp)
	movq	%rdi, %rdx
	andq	%rsi, %rdx
	movq	320(%rsp), %rsi
	addq	%rax, %rdx
	leaq	(%rcx,%rdx,8), %rcx
	movq	-112(%rsp), %rdx
	movq	%rcx, -16(%rsp)
	leaq	(%rsi,%rdx,8), %rcx
	movabsq	$9223372036854775776, %rdx
	movq	112(%rsp), %rsi
	leaq	16(%rdx), %r11
	andq	%rdi, %r11
	andq	%rdx, %rdi
	leaq	(%r9,%rax,8), %rdx
	movq	%rcx, -56(%rsp)
	movq	%rdi, -64(%rsp)
	movq	16(%rsp), %rdi
	movq	%r11, -24(%rsp)
	movq	%rdx, -80(%rsp)
	leaq	(%rsi,%rax,8), %rsi
	leaq	(%rdi,%rax,8), %rax
	movq	%rax, -32(%rsp)
	jmp	.LBB0_56
	.p2align	4
.LBB0_55:
	movq	-88(%rsp), %rax
	addq	$4, %r12
	leaq	-1(%rax), %r8
	cmpq	$1, %rax
	jbe	.LBB0_31
.LBB0_56:
	movq	520(%rsp), %rdi
	movq	528(%rsp), %r13
	movq	%r12, %rax
	sarq	$63, %rax
	movq	%r8, -88(%rsp)
	movl	$0, %r8d
	movq	576(%rsp), %rcx
	movl	$0, %r14d
	movq	%rax, %rdx
	andq	%r10, %rax
	leaq	(%rdi,%r12,8), %rdi
	andq	%r13, %rdx
	cmpq	$-1, %r12
	movq	(%rdi,%rdx,8), %r9
	movl	$0, %edx
	cmovlq	%r13, %rdx
	movq	8(%rdi,%rdx,8), %r11
	movl	$0, %edx
	cmovlq	%r10, %rdx
	cmpq	$-2, %r12
	cmovlq	%r13, %r8
	movq	16(%rdi,%r8,8), %rbx
	movl	$0, %r8d
	cmovlq	%r10, %r8
	cmpq	$-3, %r12
	cmovlq	%r13, %r14
	movq	24(%rdi,%r14,8), %r14
	leaq	(%rcx,%r12,8), %rdi
	vmovsd	(%rdi,%rax,8), %xmm0
	movl	$0, %eax
	vmovsd	8(%rdi,%rdx,8), %xmm1
	vmovsd	16(%rdi,%r8,8), %xmm2
	cmovlq	%r10, %rax
	vmovsd	24(%rdi,%rax,8), %xmm3
	testq	%r12, %r12
	je	.LBB0_66
	cmpq	$8, -120(%rsp)
	jl	.LBB0_55
	movq	328(%rsp), %r8
	movq	%r9, %rdi
	sarq	$63, %rdi
	movq	336(%rsp), %rcx
	movq	320(%rsp), %rdx
	movq	8(%rsp), %r10
	andq	%r8, %rdi
	addq	%r9, %rdi
	movq	%r11, %r9
	sarq	$63, %r9
	andq	%r8, %r9
	movq	%rdi, %rbp
	imulq	%rcx, %rbp
	imulq	%r10, %rdi
	addq	%r11, %r9
	movq	%rbx, %r11
	sarq	$63, %r11
	movq	%r9, %rax
	imulq	%rcx, %rax
	andq	%r8, %r11
	imulq	%r10, %r9
	addq	%rbx, %r11
	movq	%r14, %rbx
	sarq	$63, %rbx
	andq	%r8, %rbx
	movq	320(%rsp), %r8
	leaq	(%rdx,%rax,8), %rax
	addq	%r14, %rbx
	movq	%rax, -72(%rsp)
	movq	%r11, %rax
	imulq	%rcx, %rax
	imulq	%r10, %r11
	leaq	(%rdx,%rax,8), %r13
	movq	-56(%rsp), %rdx
	movq	%rbx, %rax
	imulq	%rcx, %rax
	movq	-96(%rsp), %rcx
	imulq	%r10, %rbx
	leaq	(%r8,%rax,8), %r8
	leaq	(%rdx,%rbx), %rax
	leaq	(%rdx,%rdi), %r10
	cmpq	%rax, %rcx
	movq	-16(%rsp), %rax
	setb	(%rsp)
	cmpq	%rax, %r8
	leaq	(%rdx,%r11), %r8
	setb	-48(%rsp)
	cmpq	%r8, %rcx
	leaq	(%rdx,%r9), %r8
	movq	320(%rsp), %rdx
	setb	%r14b
	cmpq	%rax, %r13
	setb	-40(%rsp)
	cmpq	%r8, %rcx
	setb	%r8b
	cmpq	%rax, -72(%rsp)
	setb	%r13b
	cmpq	%r10, %rcx
	leaq	(%rdx,%rbp,8), %r10
	setb	%bpl
	cmpq	%rax, %r10
	setb	%r10b
	testb	%r10b, %bpl
	jne	.LBB0_73
	andb	%r13b, %r8b
	jne	.LBB0_73
	movq	584(%rsp), %r10
	movq	-24(%rsp), %rcx
	andb	-40(%rsp), %r14b
	jne	.LBB0_74
	movzbl	-48(%rsp), %eax
	andb	%al, (%rsp)
	movl	$0, %eax
	jne	.LBB0_75
	cmpq	$16, -120(%rsp)
	vbroadcastsd	%xmm0, %zmm4
	vbroadcastsd	%xmm1, %zmm5
	vbroadcastsd	%xmm2, %zmm6
	vbroadcastsd	%xmm3, %zmm7
	jae	.LBB0_80
	xorl	%r14d, %r14d
.LBB0_64:
	movq	-96(%rsp), %rdx
	leaq	(%r11,%r14,8), %r8
	movq	-112(%rsp), %r11
	movq	320(%rsp), %r13
	leaq	(%r9,%r14,8), %rax
	leaq	(%rbx,%r14,8), %r9
	leaq	(%rdi,%r14,8), %rdi
	leaq	(%rdx,%r14,8), %rbx
	addq	%r13, %rax
	addq	%r13, %r8
	addq	%r13, %r9
	subq	%r14, %r11
	addq	%r13, %rdi
	xorl	%edx, %edx
	.p2align	4
.LBB0_65:
	vmulpd	(%rdi,%rdx,8), %zmm4, %zmm0
	vmulpd	(%rax,%rdx,8), %zmm5, %zmm1
	vmulpd	(%r8,%rdx,8), %zmm6, %zmm3
	vmulpd	(%r9,%rdx,8), %zmm7, %zmm2
	vaddpd	%zmm1, %zmm0, %zmm0
	vaddpd	%zmm3, %zmm0, %zmm0
	vaddpd	%zmm2, %zmm0, %zmm0
	vaddpd	(%rbx,%rdx,8), %zmm0, %zmm0
	vmovupd	%zmm0, (%rbx,%rdx,8)
	addq	$8, %rdx
	cmpq	%rdx, %r11
	jne	.LBB0_65
	jmp	.LBB0_55
	.p2align	4
.LBB0_66:
	cmpq	$8, -120(%rsp)
	jl	.LBB0_55
	movq	328(%rsp), %rax
	movq	%r9, %rdi
	sarq	$63, %rdi
	movq	8(%rsp), %rcx
	movq	-96(%rsp), %r8
	andq	%rax, %rdi
	movq	%r8, %rdx
	addq	%r9, %rdi
	movq	%r11, %r9
	sarq	$63, %r9
	andq	%rax, %r9
	imulq	%rcx, %rdi
	addq	%r11, %r9
	movq	%rbx, %r11
	sarq	$63, %r11
	andq	%rax, %r11
	imulq	%rcx, %r9
	addq	%rbx, %r11
	movq	%r14, %rbx
	sarq	$63, %rbx
	andq	%rax, %rbx
	imulq	%rcx, %r11
	addq	%r14, %rbx
	movq	320(%rsp), %r14
	imulq	%rcx, %rbx
	subq	%rdi, %rdx
	subq	%r14, %rdx
	cmpq	$256, %rdx
	jb	.LBB0_77
	movq	%r8, %rdx
	subq	%r9, %rdx
	subq	%r14, %rdx
	cmpq	$256, %rdx
	jb	.LBB0_77
	movq	%r8, %rdx
	subq	%r11, %rdx
	subq	%r14, %rdx
	cmpq	$256, %rdx
	jb	.LBB0_77
	movq	%r8, %rdx
	subq	%rbx, %rdx
	subq	%r14, %rdx
	movl	$0, %eax
	cmpq	$256, %rdx
	jb	.LBB0_78
	cmpq	$32, -120(%rsp)
	vbroadcastsd	%xmm0, %zmm4
	vbroadcastsd	%xmm1, %zmm5
	vbroadcastsd	%xmm2, %zmm6
	vbroadcastsd	%xmm3, %zmm7
	jae	.LBB0_84
	xorl	%r14d, %r14d
	jmp	.LBB0_88
.LBB0_73:
	movq	584(%rsp), %r10
.LBB0_74:
	xorl	%eax, %eax
.LBB0_75:
	movq	-112(%rsp), %rbp
	movq	-80(%rsp), %rdx
	movq	-8(%rsp), %rcx
	leaq	(%rdi,%rax,8), %rdi
	leaq	(%r9,%rax,8), %r9
	leaq	(%r11,%rax,8), %r11
	leaq	(%rbx,%rax,8), %rbx
	xorl	%r13d, %r13d
	leaq	(%rdx,%rax,8), %r14
	addq	%rcx, %rdi
	addq	%rcx, %r9
	addq	%rcx, %r11
	addq	%rcx, %rbx
	subq	%rax, %rbp
	.p2align	4
.LBB0_76:
	vmulsd	-24(%rdi,%r13,8), %xmm0, %xmm4
	vmulsd	-24(%r9,%r13,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-24(%r11,%r13,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-24(%rbx,%r13,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-24(%r14,%r13,8), %xmm4, %xmm4
	vmovsd	%xmm4, -24(%r14,%r13,8)
	vmulsd	-16(%rdi,%r13,8), %xmm0, %xmm4
	vmulsd	-16(%r9,%r13,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-16(%r11,%r13,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-16(%rbx,%r13,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-16(%r14,%r13,8), %xmm4, %xmm4
	vmovsd	%xmm4, -16(%r14,%r13,8)
	vmulsd	-8(%rdi,%r13,8), %xmm0, %xmm4
	vmulsd	-8(%r9,%r13,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-8(%r11,%r13,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-8(%rbx,%r13,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-8(%r14,%r13,8), %xmm4, %xmm4
	vmovsd	%xmm4, -8(%r14,%r13,8)
	vmulsd	(%rdi,%r13,8), %xmm0, %xmm4
	vmulsd	(%r9,%r13,8), %xmm1, %xmm5
	vmulsd	(%r11,%r13,8), %xmm2, %xmm7
	vmulsd	(%rbx,%r13,8), %xmm3, %xmm6
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	%xmm7, %xmm4, %xmm4
	vaddsd	%xmm6, %xmm4, %xmm4
	vaddsd	(%r14,%r13,8), %xmm4, %xmm4
	vmovsd	%xmm4, (%r14,%r13,8)
	addq	$4, %r13
	cmpq	%r13, %rbp
	jne	.LBB0_76
	jmp	.LBB0_55
.LBB0_77:
	xorl	%eax, %eax
.LBB0_78:
	movq	-80(%rsp), %rcx
	movq	-112(%rsp), %r13
	movq	-8(%rsp), %rdx
	leaq	(%rdi,%rax,8), %rdi
	leaq	(%r9,%rax,8), %r9
	leaq	(%r11,%rax,8), %r11
	leaq	(%rbx,%rax,8), %rbx
	leaq	(%rcx,%rax,8), %r14
	subq	%rax, %r13
	addq	%rdx, %rdi
	addq	%rdx, %r9
	addq	%rdx, %r11
	addq	%rdx, %rbx
	xorl	%eax, %eax
	.p2align	4
.LBB0_79:
	vmulsd	-24(%rdi,%rax,8), %xmm0, %xmm4
	vmulsd	-24(%r9,%rax,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-24(%r11,%rax,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-24(%rbx,%rax,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmovsd	%xmm4, -24(%r14,%rax,8)
	vmulsd	-16(%rdi,%rax,8), %xmm0, %xmm4
	vmulsd	-16(%r9,%rax,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-16(%r11,%rax,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-16(%rbx,%rax,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmovsd	%xmm4, -16(%r14,%rax,8)
	vmulsd	-8(%rdi,%rax,8), %xmm0, %xmm4
	vmulsd	-8(%r9,%rax,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-8(%r11,%rax,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-8(%rbx,%rax,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmovsd	%xmm4, -8(%r14,%rax,8)
	vmulsd	(%rdi,%rax,8), %xmm0, %xmm4
	vmulsd	(%r9,%rax,8), %xmm1, %xmm5
	vmulsd	(%r11,%rax,8), %xmm2, %xmm7
	vmulsd	(%rbx,%rax,8), %xmm3, %xmm6
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	%xmm7, %xmm4, %xmm4
	vaddsd	%xmm6, %xmm4, %xmm4
	vmovsd	%xmm4, (%r14,%rax,8)
	addq	$4, %rax
	cmpq	%rax, %r13
	jne	.LBB0_79
	jmp	.LBB0_55
.LBB0_80:
	movq	56(%rsp), %rdx
	xorl	%ebp, %ebp
	leaq	(%rdx,%rbx), %rax
	leaq	(%rdx,%r11), %r8
	leaq	(%rdx,%r9), %r14
	leaq	(%rdx,%rdi), %r13
	.p2align	4
.LBB0_81:
	vmulpd	(%r13,%rbp,8), %zmm4, %zmm9
	vmulpd	(%r14,%rbp,8), %zmm5, %zmm11
	vmulpd	-64(%r13,%rbp,8), %zmm4, %zmm8
	vmulpd	-64(%r14,%rbp,8), %zmm5, %zmm10
	vmulpd	-64(%r8,%rbp,8), %zmm6, %zmm12
	vaddpd	%zmm11, %zmm9, %zmm9
	vmulpd	(%r8,%rbp,8), %zmm6, %zmm11
	vaddpd	%zmm10, %zmm8, %zmm8
	vaddpd	%zmm12, %zmm8, %zmm8
	vmulpd	-64(%rax,%rbp,8), %zmm7, %zmm12
	vaddpd	%zmm11, %zmm9, %zmm9
	vmulpd	(%rax,%rbp,8), %zmm7, %zmm11
	vaddpd	%zmm12, %zmm8, %zmm8
	vaddpd	-64(%rsi,%rbp,8), %zmm8, %zmm8
	vaddpd	%zmm11, %zmm9, %zmm9
	vaddpd	(%rsi,%rbp,8), %zmm9, %zmm9
	vmovupd	%zmm8, -64(%rsi,%rbp,8)
	vmovupd	%zmm9, (%rsi,%rbp,8)
	addq	$16, %rbp
	cmpq	%rbp, %rcx
	jne	.LBB0_81
	cmpq	%rcx, -112(%rsp)
	je	.LBB0_55
	testb	$8, -120(%rsp)
	movq	%rcx, %r14
	movq	%rcx, %rax
	jne	.LBB0_64
	jmp	.LBB0_75
.LBB0_84:
	movq	120(%rsp), %rax
	movq	-64(%rsp), %rdx
	movq	-32(%rsp), %r10
	xorl	%r8d, %r8d
	leaq	(%rax,%rbx), %r14
	leaq	(%rax,%r11), %r13
	leaq	(%rax,%r9), %rbp
	addq	%rdi, %rax
	.p2align	4
.LBB0_85:
	vmulpd	-128(%rax,%r8,8), %zmm4, %zmm9
	vmulpd	-128(%rbp,%r8,8), %zmm5, %zmm13
	vmulpd	-64(%rax,%r8,8), %zmm4, %zmm10
	vmulpd	-64(%rbp,%r8,8), %zmm5, %zmm14
	vmulpd	(%rax,%r8,8), %zmm4, %zmm11
	vmulpd	-192(%rax,%r8,8), %zmm4, %zmm8
	vmulpd	-192(%rbp,%r8,8), %zmm5, %zmm12
	vaddpd	%zmm13, %zmm9, %zmm9
	vmulpd	(%rbp,%r8,8), %zmm5, %zmm13
	vaddpd	%zmm14, %zmm10, %zmm10
	vmulpd	-192(%r13,%r8,8), %zmm6, %zmm14
	vaddpd	%zmm12, %zmm8, %zmm8
	vaddpd	%zmm13, %zmm11, %zmm11
	vmulpd	-128(%r13,%r8,8), %zmm6, %zmm13
	vaddpd	%zmm14, %zmm8, %zmm8
	vmulpd	-64(%r13,%r8,8), %zmm6, %zmm14
	vaddpd	%zmm13, %zmm9, %zmm9
	vmulpd	(%r13,%r8,8), %zmm6, %zmm13
	vaddpd	%zmm14, %zmm10, %zmm10
	vmulpd	-192(%r14,%r8,8), %zmm7, %zmm14
	vaddpd	%zmm13, %zmm11, %zmm11
	vmulpd	-128(%r14,%r8,8), %zmm7, %zmm13
	vaddpd	%zmm14, %zmm8, %zmm8
	vmulpd	-64(%r14,%r8,8), %zmm7, %zmm14
	vaddpd	%zmm13, %zmm9, %zmm9
	vmulpd	(%r14,%r8,8), %zmm7, %zmm13
	vaddpd	%zmm14, %zmm10, %zmm10
	vmovupd	%zmm8, -192(%r10,%r8,8)
	vmovupd	%zmm9, -128(%r10,%r8,8)
	vmovupd	%zmm10, -64(%r10,%r8,8)
	vaddpd	%zmm13, %zmm11, %zmm11
	vmovupd	%zmm11, (%r10,%r8,8)
	addq	$32, %r8
	cmpq	%r8, %rdx
	jne	.LBB0_85
	movq	584(%rsp), %r10
	cmpq	%rdx, -112(%rsp)
	je	.LBB0_55
	movq	-64(%rsp), %rax
	testb	$24, -120(%rsp)
	movq	%rax, %r14
	je	.LBB0_78
.LBB0_88:
	movq	-96(%rsp), %rdx
	leaq	(%rbx,%r14,8), %r8
	movq	-112(%rsp), %rbx
	movq	320(%rsp), %r13
	leaq	(%r11,%r14,8), %rax
	leaq	(%r9,%r14,8), %r9
	leaq	(%rdi,%r14,8), %rdi
	leaq	(%rdx,%r14,8), %r11
	addq	%r13, %rax
	addq	%r13, %r8
	subq	%r14, %rbx
	addq	%r13, %r9
	addq	%r13, %rdi
	xorl	%edx, %edx
	.p2align	4
.LBB0_89:
	vmulpd	(%rdi,%rdx,8), %zmm4, %zmm0
	vmulpd	(%r9,%rdx,8), %zmm5, %zmm1
	vmulpd	(%rax,%rdx,8), %zmm6, %zmm3
	vmulpd	(%r8,%rdx,8), %zmm7, %zmm2
	vaddpd	%zmm1, %zmm0, %zmm0
	vaddpd	%zmm3, %zmm0, %zmm0
	vaddpd	%zmm2, %zmm0, %zmm0
	vmovupd	%zmm0, (%r11,%rdx,8)
	addq	$8, %rdx
	cmpq	%rdx, %rbx
	jne	.LBB0_89
	jmp	.LBB0_55
	.p2align	4
.LBB0_11:
	leaq	7(%rcx,%rax,2), %rdi
	movq	-16(%rsp), %rax
	movabsq	$2305843009213693944, %rdx
	movq	320(%rsp), %r9
	movq	392(%rsp), %rbp
	movq	%rdi, %rcx
	andq	%rdx, %rcx
	movq	%rdi, %r8
	andq	$-8, %r8
	movq	%rdi, -80(%rsp)
	movq	%r8, -88(%rsp)
	leaq	7(%rdx,%rax), %rax
	imulq	336(%rsp), %rax
	xorl	%edx, %edx
	addq	%rax, %rcx
	leaq	(%r9,%rcx,8), %rax
	leaq	(%rbp,%r8,8), %rcx
	movq	80(%rsp), %r8
	movq	88(%rsp), %r9
	movq	%rax, 184(%rsp)
	leaq	(%r15,%r15,2), %rax
	movq	%rcx, 176(%rsp)
	addq	%rcx, %rax
	movq	%r8, -24(%rsp)
	movq	24(%rsp), %r8
	movq	%rax, 168(%rsp)
	movq	96(%rsp), %rax
	movq	%r9, -64(%rsp)
	movq	32(%rsp), %r9
	movq	%r8, -32(%rsp)
	movq	40(%rsp), %r8
	addq	%rcx, %rax
	addq	%r15, %rcx
	movq	%r9, -56(%rsp)
	movq	%rcx, 152(%rsp)
	movq	%rdi, %rcx
	andq	$-16, %rcx
	xorl	%edi, %edi
	movq	%rax, 160(%rsp)
	movq	%r8, 64(%rsp)
	jmp	.LBB0_13
	.p2align	4
.LBB0_12:
	movq	48(%rsp), %rsi
	movq	-120(%rsp), %rdi
	movq	200(%rsp), %rdx
	addq	%rsi, 64(%rsp)
	addq	%rsi, -56(%rsp)
	addq	%rsi, -32(%rsp)
	addq	%rsi, -64(%rsp)
	addq	%rsi, -24(%rsp)
	addq	$4, %rdi
	incq	%rdx
	addq	%rsi, %rbp
	cmpq	$3, %rdx
	je	.LBB0_5
.LBB0_13:
	cmpq	$8, -80(%rsp)
	movabsq	$1152921504606846976, %rax
	movq	168(%rsp), %r8
	movq	%rdx, 200(%rsp)
	movq	392(%rsp), %r9
	movq	%rdi, %r11
	movq	%rdi, %r13
	setb	-121(%rsp)
	testq	%rax, 336(%rsp)
	movq	40(%rsp), %rax
	setne	-104(%rsp)
	imulq	%rsi, %rdx
	movq	32(%rsp), %rsi
	orq	$1, %r13
	movq	%r13, -112(%rsp)
	leaq	(%r8,%rdx), %r14
	movq	160(%rsp), %r8
	leaq	(%rax,%rdx), %rbx
	leaq	(%rsi,%rdx), %r10
	movq	24(%rsp), %rsi
	leaq	(%r8,%rdx), %r12
	movq	152(%rsp), %r8
	leaq	(%rsi,%rdx), %rax
	leaq	(%r9,%rdx), %rsi
	movq	%rax, -48(%rsp)
	movq	%rsi, 192(%rsp)
	movq	%rdi, %rsi
	orq	$2, %rdi
	movq	%rsi, -120(%rsp)
	orq	$3, %rsi
	movq	%rdi, -96(%rsp)
	movq	%rsi, -72(%rsp)
	leaq	(%r8,%rdx), %rax
	movq	320(%rsp), %r8
	addq	176(%rsp), %rdx
	movq	%rax, -40(%rsp)
	movq	408(%rsp), %rax
	imulq	%rax, %r11
	imulq	%rax, %r13
	imulq	%rax, %rdi
	imulq	%rax, %rsi
	cmpq	%r14, %r8
	movq	184(%rsp), %r14
	setb	%al
	cmpq	%r14, %rbx
	setb	%bl
	andb	%al, %bl
	cmpq	%r12, %r8
	setb	%al
	cmpq	%r14, %r10
	setb	%r10b
	andb	%al, %r10b
	orb	-104(%rsp), %r10b
	cmpq	-40(%rsp), %r8
	leaq	(%r9,%r11,8), %rax
	movq	%rax, -104(%rsp)
	leaq	(%r9,%r13,8), %rax
	movq	%rax, -40(%rsp)
	leaq	(%r9,%rdi,8), %rax
	setb	%dil
	cmpq	%r14, -48(%rsp)
	movq	%rax, (%rsp)
	leaq	(%r9,%rsi,8), %rax
	movq	%rax, -48(%rsp)
	setb	%al
	andb	%dil, %al
	movq	56(%rsp), %rdi
	orb	%bl, %al
	orb	%r10b, %al
	cmpq	%rdx, %r8
	setb	%dl
	cmpq	%r14, 192(%rsp)
	setb	%r13b
	xorl	%ebx, %ebx
	andb	%dl, %r13b
	orb	-121(%rsp), %r13b
	movq	%r8, %rdx
	orb	%al, %r13b
	movq	-8(%rsp), %rax
	jmp	.LBB0_15
	.p2align	4
.LBB0_14:
	movq	8(%rsp), %rsi
	incq	%rbx
	addq	%rsi, %rdi
	addq	%rsi, %rdx
	addq	%rsi, %rax
	cmpq	%rbx, -16(%rsp)
	je	.LBB0_12
.LBB0_15:
	movq	464(%rsp), %rsi
	movq	-120(%rsp), %r8
	movq	-104(%rsp), %r9
	movq	-40(%rsp), %r10
	vmovsd	(%rsi,%r8,8), %xmm0
	movq	-112(%rsp), %r8
	vmulsd	(%r9,%rbx,8), %xmm0, %xmm0
	movq	(%rsp), %r9
	vmovsd	(%rsi,%r8,8), %xmm1
	movq	-96(%rsp), %r8
	vmulsd	(%r10,%rbx,8), %xmm1, %xmm1
	vmovsd	(%rsi,%r8,8), %xmm2
	movq	-72(%rsp), %r8
	vmulsd	(%r9,%rbx,8), %xmm2, %xmm2
	vmovsd	(%rsi,%r8,8), %xmm3
	movq	-48(%rsp), %r8
	vmulsd	(%r8,%rbx,8), %xmm3, %xmm3
	testb	$1, %r13b
	je	.LBB0_19
	xorl	%r14d, %r14d
.LBB0_17:
	movq	-88(%rsp), %r9
	movq	-56(%rsp), %rsi
	movq	-64(%rsp), %r10
	movq	-24(%rsp), %r12
	leaq	(%rax,%r14,8), %r11
	leaq	(%rbp,%r14,8), %r8
	leaq	(%rsi,%r14,8), %rsi
	subq	%r14, %r9
	leaq	(%r10,%r14,8), %r10
	leaq	(%r12,%r14,8), %r14
	xorl	%r12d, %r12d
	.p2align	4
.LBB0_18:
	vmulsd	(%r8,%r12,8), %xmm0, %xmm4
	vmulsd	-24(%r10,%r12,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	(%rsi,%r12,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-24(%r14,%r12,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-24(%r11,%r12,8), %xmm4, %xmm4
	vmovsd	%xmm4, -24(%r11,%r12,8)
	vmulsd	8(%r8,%r12,8), %xmm0, %xmm4
	vmulsd	-16(%r10,%r12,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	8(%rsi,%r12,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-16(%r14,%r12,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-16(%r11,%r12,8), %xmm4, %xmm4
	vmovsd	%xmm4, -16(%r11,%r12,8)
	vmulsd	16(%r8,%r12,8), %xmm0, %xmm4
	vmulsd	-8(%r10,%r12,8), %xmm1, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	16(%rsi,%r12,8), %xmm2, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vmulsd	-8(%r14,%r12,8), %xmm3, %xmm5
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	-8(%r11,%r12,8), %xmm4, %xmm4
	vmovsd	%xmm4, -8(%r11,%r12,8)
	vmulsd	24(%r8,%r12,8), %xmm0, %xmm4
	vmulsd	(%r10,%r12,8), %xmm1, %xmm5
	vmulsd	24(%rsi,%r12,8), %xmm2, %xmm7
	vmulsd	(%r14,%r12,8), %xmm3, %xmm6
	vaddsd	%xmm5, %xmm4, %xmm4
	vaddsd	%xmm7, %xmm4, %xmm4
	vaddsd	%xmm6, %xmm4, %xmm4
	vaddsd	(%r11,%r12,8), %xmm4, %xmm4
	vmovsd	%xmm4, (%r11,%r12,8)
	addq	$4, %r12
	cmpq	%r12, %r9
	jne	.LBB0_18
	jmp	.LBB0_14
	.p2align	4
.LBB0_19:
	cmpq	$16, -80(%rsp)
	vbroadcastsd	%xmm0, %zmm4
	vbroadcastsd	%xmm1, %zmm5
	vbroadcastsd	%xmm2, %zmm6
	vbroadcastsd	%xmm3, %zmm7
	jae	.LBB0_23
	xorl	%r12d, %r12d
.LBB0_21:
	movq	-32(%rsp), %rsi
	movq	-56(%rsp), %r8
	movq	64(%rsp), %r9
	movq	-88(%rsp), %r10
	leaq	(%rbp,%r12,8), %r11
	leaq	(%rdx,%r12,8), %r14
	leaq	(%rsi,%r12,8), %rsi
	leaq	(%r8,%r12,8), %r8
	leaq	(%r9,%r12,8), %r9
	subq	%r12, %r10
	xorl	%r12d, %r12d
	.p2align	4
.LBB0_22:
	vmulpd	(%r11,%r12,8), %zmm4, %zmm0
	vmulpd	(%rsi,%r12,8), %zmm5, %zmm1
	vmulpd	(%r8,%r12,8), %zmm6, %zmm3
	vmulpd	(%r9,%r12,8), %zmm7, %zmm2
	vaddpd	%zmm1, %zmm0, %zmm0
	vaddpd	%zmm3, %zmm0, %zmm0
	vaddpd	%zmm2, %zmm0, %zmm0
	vaddpd	(%r14,%r12,8), %zmm0, %zmm0
	vmovupd	%zmm0, (%r14,%r12,8)
	addq	$8, %r12
	cmpq	%r12, %r10
	jne	.LBB0_22
	jmp	.LBB0_14
	.p2align	4
.LBB0_23:
	xorl	%esi, %esi
	.p2align	4
.LBB0_24:
	leaq	(%rbp,%rsi,8), %r8
	vmulpd	64(%rbp,%rsi,8), %zmm4, %zmm9
	vmulpd	(%rbp,%rsi,8), %zmm4, %zmm8
	vmulpd	64(%r15,%r8), %zmm5, %zmm11
	vmulpd	(%r15,%r8), %zmm5, %zmm10
	leaq	(%r8,%r15), %r9
	vmulpd	(%r15,%r9), %zmm6, %zmm12
	leaq	(%r9,%r15), %r8
	vaddpd	%zmm11, %zmm9, %zmm9
	vmulpd	64(%r15,%r9), %zmm6, %zmm11
	vaddpd	%zmm10, %zmm8, %zmm8
	vaddpd	%zmm12, %zmm8, %zmm8
	vmulpd	(%r15,%r8), %zmm7, %zmm12
	vaddpd	%zmm11, %zmm9, %zmm9
	vmulpd	64(%r15,%r8), %zmm7, %zmm11
	vaddpd	%zmm12, %zmm8, %zmm8
	vaddpd	-64(%rdi,%rsi,8), %zmm8, %zmm8
	vaddpd	%zmm11, %zmm9, %zmm9
	vaddpd	(%rdi,%rsi,8), %zmm9, %zmm9
	vmovupd	%zmm8, -64(%rdi,%rsi,8)
	vmovupd	%zmm9, (%rdi,%rsi,8)
	addq	$16, %rsi
	cmpq	%rsi, %rcx
	jne	.LBB0_24
	cmpq	%rcx, -88(%rsp)
	je	.LBB0_14
	testb	$8, -80(%rsp)
	movq	%rcx, %r14
	movq	%rcx, %r12
	je	.LBB0_17
	jmp	.LBB0_21
.LBB0_91:
	xorl	%ecx, %ecx
.LBB0_92:
	movq	72(%rsp), %rax
	movq	$0, 80(%rbx)
	movq	%rcx, (%rax)
	xorl	%eax, %eax
	addq	$208, %rsp
	popq	%rbx
	popq	%r12
	popq	%r13
	popq	%r14
	popq	%r15
	popq	%rbp
	vzeroupper
	retq
.Lfunc_end0:
	.size	_ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx, .Lfunc_end0-_ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx

	.globl	_ZN7cpython8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx
	.p2align	4
	.type	_ZN7cpython8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx,@function
_ZN7cpython8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx:
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
	subq	$2200, %rsp
	.cfi_def_cfa_offset 2256
	.cfi_offset %rbx, -56
	.cfi_offset %r12, -48
	.cfi_offset %r13, -40
	.cfi_offset %r14, -32
	.cfi_offset %r15, -24
	.cfi_offset %rbp, -16
	leaq	1088(%rsp), %rax
	movq	%rsi, %rdi
	movabsq	$.const.r_project, %rsi
	movabsq	$PyArg_UnpackTuple, %r10
	leaq	1112(%rsp), %r8
	leaq	1104(%rsp), %r9
	movl	$4, %edx
	movl	$4, %ecx
	movq	%rax, 8(%rsp)
	leaq	1096(%rsp), %rax
	movq	%rax, (%rsp)
	xorl	%eax, %eax
	callq	*%r10
	vxorps	%xmm0, %xmm0, %xmm0
	vxorps	%xmm1, %xmm1, %xmm1
	vmovups	%ymm0, 1728(%rsp)
	vmovups	%ymm0, 1248(%rsp)
	vmovups	%ymm0, 1184(%rsp)
	vmovups	%ymm0, 1120(%rsp)
	vmovups	%ymm0, 1376(%rsp)
	vmovups	%ymm0, 1688(%rsp)
	vmovups	%zmm1, 2112(%rsp)
	vmovups	%ymm0, 1600(%rsp)
	vmovups	%ymm0, 1312(%rsp)
	vmovups	%ymm0, 1752(%rsp)
	vmovups	%zmm1, 1520(%rsp)
	movq	$0, 1584(%rsp)
	vmovups	%zmm1, 1440(%rsp)
	movq	$0, 1504(%rsp)
	vmovups	%ymm0, 1272(%rsp)
	vmovups	%ymm0, 1208(%rsp)
	vmovups	%ymm0, 1144(%rsp)
	vmovups	%ymm0, 1400(%rsp)
	vmovups	%ymm0, 1664(%rsp)
	vmovups	%zmm1, 2032(%rsp)
	movq	$0, 2096(%rsp)
	vmovups	%zmm1, 1952(%rsp)
	movq	$0, 2016(%rsp)
	vmovups	%zmm1, 2136(%rsp)
	vmovups	%zmm1, 1872(%rsp)
	movq	$0, 1936(%rsp)
	vmovups	%ymm0, 1624(%rsp)
	vmovups	%ymm0, 1336(%rsp)
	vmovups	%zmm1, 1792(%rsp)
	movq	$0, 1856(%rsp)
	movq	$0, 968(%rsp)
	testl	%eax, %eax
	je	.LBB1_1
	movabsq	$_ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx, %rax
	cmpq	$0, (%rax)
	je	.LBB1_4
	movq	1112(%rsp), %rbx
	movabsq	$PyTuple_Size, %rax
	movq	%rbx, %rdi
	vzeroupper
	callq	*%rax
	cmpq	$15, %rax
	setne	%r12b
	jne	.LBB1_7
.LBB1_8:
	movabsq	$PyTuple_GetItem, %r14
	movq	%rbx, %rdi
	xorl	%esi, %esi
	callq	*%r14
	movabsq	$numba_adapt_ndarray, %r15
	leaq	1728(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1728(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1752(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_10
	cmpq	$8, 1752(%rsp)
	jne	.LBB1_10
.LBB1_11:
	movl	$1, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1520(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1520(%rsp)
	movq	$0, 1584(%rsp)
	vzeroupper
	callq	*%r15
	cmpq	$8, 1544(%rsp)
	setne	%cl
	testl	%eax, %eax
	setne	%bpl
	orb	%cl, %bpl
	cmpb	$1, %bpl
	je	.LBB1_12
	testb	%bpl, %bpl
	jne	.LBB1_14
.LBB1_15:
	movq	1560(%rsp), %rax
	movq	1568(%rsp), %rcx
	movq	1552(%rsp), %r13
	movl	$2, %esi
	movq	%rbx, %rdi
	movq	%rax, 1080(%rsp)
	movq	%rcx, 1072(%rsp)
	callq	*%r14
	leaq	1440(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1440(%rsp)
	movq	$0, 1504(%rsp)
	vzeroupper
	callq	*%r15
	cmpq	$8, 1464(%rsp)
	setne	%cl
	testl	%eax, %eax
	setne	%bpl
	orb	%cl, %bpl
	cmpb	$1, %bpl
	je	.LBB1_16
	testb	%bpl, %bpl
	jne	.LBB1_18
.LBB1_19:
	movq	1480(%rsp), %rax
	movq	1488(%rsp), %rcx
	movq	1472(%rsp), %rbp
	movl	$3, %esi
	movq	%rbx, %rdi
	movq	%rax, 1064(%rsp)
	movq	%rcx, 1056(%rsp)
	callq	*%r14
	leaq	1248(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1248(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1272(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_21
	cmpq	$8, 1272(%rsp)
	jne	.LBB1_21
.LBB1_22:
	movq	1280(%rsp), %rax
	movq	1288(%rsp), %rcx
	movl	$4, %esi
	movq	%rbx, %rdi
	movq	%rax, 1048(%rsp)
	movq	%rcx, 1040(%rsp)
	callq	*%r14
	leaq	1184(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1184(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1208(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_24
	cmpq	$8, 1208(%rsp)
	jne	.LBB1_24
.LBB1_25:
	movq	1216(%rsp), %rax
	movq	1224(%rsp), %rcx
	movl	$5, %esi
	movq	%rbx, %rdi
	movq	%rax, 1032(%rsp)
	movq	%rcx, 1024(%rsp)
	callq	*%r14
	leaq	1120(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1120(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1144(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_27
	cmpq	$8, 1144(%rsp)
	jne	.LBB1_27
.LBB1_28:
	movq	1152(%rsp), %rax
	movq	1160(%rsp), %rcx
	movl	$6, %esi
	movq	%rbx, %rdi
	movq	%rax, 1016(%rsp)
	movq	%rcx, 1008(%rsp)
	callq	*%r14
	leaq	1376(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1376(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1400(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_30
	cmpq	$8, 1400(%rsp)
	jne	.LBB1_30
.LBB1_31:
	movq	1408(%rsp), %rax
	movl	$7, %esi
	movq	%rbx, %rdi
	movq	%rax, 1000(%rsp)
	callq	*%r14
	leaq	1664(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1664(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1688(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_33
	cmpq	$8, 1688(%rsp)
	jne	.LBB1_33
.LBB1_34:
	movl	$8, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	2032(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 2032(%rsp)
	movq	$0, 2096(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_36
	cmpq	$8, 2056(%rsp)
	jne	.LBB1_36
.LBB1_37:
	movl	$9, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1952(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1952(%rsp)
	movq	$0, 2016(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_39
	cmpq	$8, 1976(%rsp)
	jne	.LBB1_39
.LBB1_40:
	movl	$10, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	2112(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%zmm0, 2112(%rsp)
	movq	%rax, %rdi
	vmovups	%zmm0, 2136(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_42
	cmpq	$8, 2136(%rsp)
	jne	.LBB1_42
.LBB1_43:
	movl	$11, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1872(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1872(%rsp)
	movq	$0, 1936(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_45
	cmpq	$8, 1896(%rsp)
	jne	.LBB1_45
.LBB1_46:
	movl	$12, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1600(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1600(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1624(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_48
	cmpq	$8, 1624(%rsp)
	jne	.LBB1_48
.LBB1_49:
	movl	$13, %esi
	movq	%rbx, %rdi
	callq	*%r14
	leaq	1312(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	vmovups	%ymm0, 1312(%rsp)
	movq	%rax, %rdi
	vmovups	%ymm0, 1336(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_51
	cmpq	$8, 1336(%rsp)
	jne	.LBB1_51
.LBB1_52:
	movq	1344(%rsp), %rax
	movl	$14, %esi
	movq	%rbx, %rdi
	movq	%rax, 992(%rsp)
	callq	*%r14
	leaq	1792(%rsp), %rsi
	vxorps	%xmm0, %xmm0, %xmm0
	movq	%rax, %rdi
	vmovups	%zmm0, 1792(%rsp)
	movq	$0, 1856(%rsp)
	vzeroupper
	callq	*%r15
	testl	%eax, %eax
	jne	.LBB1_54
	cmpq	$8, 1816(%rsp)
	jne	.LBB1_54
	testb	%r12b, %r12b
	jne	.LBB1_1
	movq	1104(%rsp), %rdi
	movabsq	$PyNumber_Long, %r12
	movq	%rbp, 976(%rsp)
	movq	%r13, 984(%rsp)
	callq	*%r12
	movabsq	$PyLong_AsLongLong, %r13
	movabsq	$Py_DecRef, %rbx
	testq	%rax, %rax
	je	.LBB1_57
	movq	%rax, %rdi
	movq	%rax, %r14
	callq	*%r13
	movq	%r14, %rdi
	movq	%rax, %rbp
	callq	*%rbx
	movabsq	$PyErr_Occurred, %rbx
	callq	*%rbx
	testq	%rax, %rax
	jne	.LBB1_1
.LBB1_60:
	movq	1096(%rsp), %rdi
	callq	*%r12
	testq	%rax, %rax
	je	.LBB1_61
	movq	%rax, %rdi
	movq	%rax, %r15
	callq	*%r13
	movq	%r15, %rdi
	movabsq	$Py_DecRef, %r15
	movq	%rax, %r14
	callq	*%r15
	callq	*%rbx
	testq	%rax, %rax
	jne	.LBB1_1
.LBB1_64:
	movq	1088(%rsp), %rdi
	callq	*%r12
	testq	%rax, %rax
	je	.LBB1_65
	movq	%rax, %rdi
	movq	%rax, %r12
	callq	*%r13
	movq	%r12, %rdi
	movabsq	$Py_DecRef, %r12
	movq	%rax, %r15
	callq	*%r12
.LBB1_67:
	movq	984(%rsp), %r12
	movq	976(%rsp), %r13
	callq	*%rbx
	testq	%rax, %rax
	jne	.LBB1_1
	movq	1000(%rsp), %rdi
	movq	1008(%rsp), %r10
	movq	992(%rsp), %rax
	movq	$0, 968(%rsp)
	movq	%r15, 952(%rsp)
	movq	%r14, 944(%rsp)
	movq	%rbp, 936(%rsp)
	movq	%r13, 128(%rsp)
	movq	%r12, 56(%rsp)
	movq	%rdi, 368(%rsp)
	movq	1016(%rsp), %rdi
	movq	%r10, 320(%rsp)
	movq	1024(%rsp), %r10
	movq	%rax, 840(%rsp)
	movabsq	$_ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx, %rax
	movq	%rdi, 312(%rsp)
	movq	1032(%rsp), %rdi
	movq	%r10, 264(%rsp)
	movq	1040(%rsp), %r10
	movq	%rdi, 256(%rsp)
	movq	1048(%rsp), %rdi
	movq	%r10, 208(%rsp)
	movq	1056(%rsp), %r10
	movq	%rdi, 200(%rsp)
	movq	1064(%rsp), %rdi
	movq	%r10, 144(%rsp)
	movq	1072(%rsp), %r10
	movq	%rdi, 136(%rsp)
	movq	1080(%rsp), %rdi
	movq	%r10, 72(%rsp)
	movq	%rdi, 64(%rsp)
	leaq	968(%rsp), %rdi
	callq	*%rax
	movq	968(%rsp), %rdi
	movabsq	$PyLong_FromLongLong, %rax
	callq	*%rax
.LBB1_2:
	addq	$2200, %rsp
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
.LBB1_4:
	.cfi_def_cfa_offset 2256
	movabsq	$PyExc_RuntimeError, %rdi
	movabsq	$".const.missing Environment: _ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx", %rsi
	jmp	.LBB1_5
.LBB1_10:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_11
.LBB1_21:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_22
.LBB1_24:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_25
.LBB1_27:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_28
.LBB1_30:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_31
.LBB1_33:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_34
.LBB1_36:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_37
.LBB1_39:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_40
.LBB1_42:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_43
.LBB1_45:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_46
.LBB1_48:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_49
.LBB1_51:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	movb	$1, %r12b
	jmp	.LBB1_52
.LBB1_54:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
.LBB1_5:
	movabsq	$PyErr_SetString, %rax
	vzeroupper
	callq	*%rax
.LBB1_1:
	xorl	%eax, %eax
	jmp	.LBB1_2
.LBB1_7:
	movabsq	$PyExc_ValueError, %rdi
	movabsq	$".const.size mismatch for tuple, expected 15 element(s) but got %zd", %rsi
	movabsq	$PyErr_Format, %rcx
	movq	%rax, %rdx
	xorl	%eax, %eax
	callq	*%rcx
	jmp	.LBB1_8
.LBB1_12:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	testb	%bpl, %bpl
	je	.LBB1_15
.LBB1_14:
	movb	$1, %r12b
	jmp	.LBB1_15
.LBB1_16:
	movabsq	$PyExc_TypeError, %rdi
	movabsq	$".const.can't unbox array from PyObject into native value.  The object maybe of a different type", %rsi
	movabsq	$PyErr_SetString, %rax
	callq	*%rax
	testb	%bpl, %bpl
	je	.LBB1_19
.LBB1_18:
	movb	$1, %r12b
	jmp	.LBB1_19
.LBB1_57:
	xorl	%ebp, %ebp
	movabsq	$PyErr_Occurred, %rbx
	callq	*%rbx
	testq	%rax, %rax
	je	.LBB1_60
	jmp	.LBB1_1
.LBB1_61:
	xorl	%r14d, %r14d
	callq	*%rbx
	testq	%rax, %rax
	je	.LBB1_64
	jmp	.LBB1_1
.LBB1_65:
	xorl	%r15d, %r15d
	jmp	.LBB1_67
.Lfunc_end1:
	.size	_ZN7cpython8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx, .Lfunc_end1-_ZN7cpython8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx
	.cfi_endproc

	.globl	cfunc._ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx
	.p2align	4
	.type	cfunc._ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx,@function
cfunc._ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx:
	subq	$968, %rsp
	vmovaps	1088(%rsp), %xmm1
	vmovups	1160(%rsp), %xmm2
	vmovaps	1216(%rsp), %xmm3
	vmovups	1272(%rsp), %xmm4
	vmovups	1896(%rsp), %xmm5
	vmovups	1016(%rsp), %xmm0
	movq	1912(%rsp), %rdi
	movq	1032(%rsp), %rax
	movq	1104(%rsp), %rcx
	movq	1328(%rsp), %rdx
	movq	1800(%rsp), %rsi
	movq	$0, 960(%rsp)
	movq	%rdi, 952(%rsp)
	leaq	960(%rsp), %rdi
	vmovups	%xmm5, 936(%rsp)
	movq	%rsi, 840(%rsp)
	movq	%rdx, 368(%rsp)
	vmovups	%xmm4, 312(%rsp)
	vmovups	%xmm3, 256(%rsp)
	vmovups	%xmm2, 200(%rsp)
	movq	%rcx, 144(%rsp)
	vmovups	%xmm1, 128(%rsp)
	movq	%rax, 72(%rsp)
	movabsq	$_ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx, %rax
	vmovups	%xmm0, 56(%rsp)
	callq	*%rax
	movq	960(%rsp), %rax
	addq	$968, %rsp
	retq
.Lfunc_end2:
	.size	cfunc._ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx, .Lfunc_end2-cfunc._ZN8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx

	.type	.const.r_project,@object
	.section	.lrodata,"al",@progbits
.const.r_project:
	.asciz	"r_project"
	.size	.const.r_project, 10

	.type	_ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx,@object
	.comm	_ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx,8,8
	.type	".const.missing Environment: _ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx",@object
	.p2align	4, 0x0
".const.missing Environment: _ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx":
	.asciz	"missing Environment: _ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx"
	.size	".const.missing Environment: _ZN08NumbaEnv8__main__9r_projectB2v2B36c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWpoAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29xxx", 688

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

	.type	_ZN08NumbaEnv7skyless11positioning13joint_algebra7projectB3v83B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,@object
	.comm	_ZN08NumbaEnv7skyless11positioning13joint_algebra7projectB3v83B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,8,8
	.type	_ZN08NumbaEnv7skyless11positioning13joint_algebra8new_termB3v68B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29d,@object
	.comm	_ZN08NumbaEnv7skyless11positioning13joint_algebra8new_termB3v68B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29d,8,8
	.type	_ZN08NumbaEnv7skyless11positioning13joint_algebra6settleB3v69B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,@object
	.comm	_ZN08NumbaEnv7skyless11positioning13joint_algebra6settleB3v69B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,8,8
	.type	_ZN08NumbaEnv7skyless11positioning11joint_state5widthB3v66B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,@object
	.comm	_ZN08NumbaEnv7skyless11positioning11joint_state5widthB3v66B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,8,8
	.type	_ZN08NumbaEnv7skyless11positioning11joint_state6statesB3v62B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,@object
	.comm	_ZN08NumbaEnv7skyless11positioning11joint_state6statesB3v62B52c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFSqgGLaAIAE584JointArrays_28array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_2c_20array_28int64_2c_203d_2c_20C_29_2c_20array_28int64_2c_202d_2c_20C_29_2c_20array_28int64_2c_201d_2c_20C_29_2c_20array_28float64_2c_201d_2c_20C_29_2c_20array_28float64_2c_202d_2c_20C_29_29,8,8
	.type	_ZN08NumbaEnv5numba7cpython8builtins6ol_int12_3clocals_3e4implB3v57B54c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFmRIMlNAE_3dEd,@object
	.comm	_ZN08NumbaEnv5numba7cpython8builtins6ol_int12_3clocals_3e4implB3v57B54c8tJTIeFIjxB2IKSgI4CrvQCk0Z4yRYcWsCAQUQzVBFmRIMlNAE_3dEd,8,8
	.section	".note.GNU-stack","",@progbits
