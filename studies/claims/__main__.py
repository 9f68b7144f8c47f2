from studies.claims.study import main

main()
