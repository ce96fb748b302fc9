"""What estimation computes with: the compiler, array types, small linear algebra."""
