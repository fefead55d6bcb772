"""What the project is made of: licences of its dependencies, and known vulnerabilities in them."""
